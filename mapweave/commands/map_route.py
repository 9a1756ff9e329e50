"""`mapweave map route`: the way from node to node, and why it leads so or why there is none."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands.network import add_network

if TYPE_CHECKING:
    from mapweave.hybridmap.explanation import RouteExplanation
    from mapweave.hybridmap.node import NodeId


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "route",
        help="the way from node to node, and why it leads so, or why there is none",
        description="Explain the route from one node or named place to another (r0.1.17 kitchen), step by "
        "step; why not a shorter one; or why there is no way at all: what of it cannot be driven, what is "
        "blocked, or which maps would have to be one. A running server is asked, or a map file. "
        "Exit status 0: there is a way; 2: there is none; 1: could not ask.",
    )
    parser.add_argument("start", metavar="START", help="a node, a named place, or a position")
    parser.add_argument("goal", metavar="GOAL", help="another one")
    parser.add_argument(
        "--blocked", nargs=2, action="append", default=[], metavar="NODE",
        help="as if a robot could not get through between these two; may be given again",
    )  # fmt: skip
    parser.add_argument("--map", type=Path, metavar="FILE", help="of this map file; no server is asked")
    parser.add_argument("--draw", type=Path, metavar="PNG", help="draw the way on the map")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--timeout", type=float, default=20.0, metavar="S", help="longest wait for an answer")
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask and print."""
    from mapweave.commands.map_ends import node_of, resolved
    from mapweave.explanation_text import route_words
    from mapweave.extras import need
    from mapweave.mapserver.http.json_values import json_values

    if arguments.draw is not None:
        need("viz")
    words = [arguments.start, arguments.goal, *(word for pair in arguments.blocked for word in pair)]
    start, goal, *rest = map(node_of, resolved(arguments, words))
    blocked = tuple(zip(rest[::2], rest[1::2], strict=True))
    explanation = explained_route(arguments, start, goal, blocked)
    values, lines = json_values(explanation), route_words(explanation)
    if arguments.draw is not None and explanation.found:
        draw_route(arguments, explanation)
        values["picture"] = str(arguments.draw)
        lines.append(f"  picture   {arguments.draw}")
    print(json.dumps(values) if arguments.json else "\n".join(lines))
    if arguments.draw is not None and not explanation.found:
        print(f"{arguments.draw} is not drawn: there is no way", file=sys.stderr)
    return 0 if explanation.found else 2


def draw_route(arguments: argparse.Namespace, explanation: RouteExplanation) -> None:
    """Draw a way on the part of the map through which it leads."""
    import numpy as np

    from mapweave.commands.map_ends import ask
    from mapweave.drawing.map_picture import Drive, MapPicture, draw_map
    from mapweave.hybridmap.hybrid_map import HybridMap
    from mapweave.storage.map_file import read_map_file, unpack_map_file
    from mapweave.wire.keys import Keys

    if arguments.map is None:
        content = unpack_map_file(ask(arguments, Keys.any_server_map, b"")[0].payload)
    else:
        content = read_map_file(arguments.map, "merged")
    part, _ = content.poses[explanation.start]
    poses = {node: p.mean for node, (number, p) in content.poses.items() if number == part}
    way = [poses[node] for node in (explanation.start, *(hop.b for hop in explanation.hops))]
    places = np.array([[pose.x, pose.y] for pose in way])
    drive = Drive(places, way[0], way[-1], "the way", begun="start")
    title = f"{explanation.start} to {explanation.goal}\n{explanation.reason}"
    edges = list(HybridMap(content.changes).edges.values())
    draw_map(MapPicture(title, poses, edges, drives=[drive]), arguments.draw)


def explained_route(
    arguments: argparse.Namespace, start: NodeId, goal: NodeId, blocked: tuple[tuple[NodeId, NodeId], ...]
) -> RouteExplanation:
    """A route through a map file, or through what a server has."""
    from mapweave.commands.map_ends import ask
    from mapweave.hybridmap.explanation import RouteExplanation
    from mapweave.hybridmap.query import ExplainRequest
    from mapweave.wire.keys import Keys
    from mapweave.wire.messages import decode, encode

    if arguments.map is None:
        request = ExplainRequest((start, goal), True, blocked)
        replies = ask(arguments, Keys.any_explain, encode(request))
        return decode(replies[0].payload, RouteExplanation)
    from mapweave.commands.network import settings_of
    from mapweave.mapserver.map_files import merged_of
    from mapweave.mapserver.route_explaining import explain_route
    from mapweave.mapserver.routes import Router
    from mapweave.storage.map_file import read_map_file

    settings = settings_of(arguments).merge
    router = Router(merged_of(read_map_file(arguments.map), settings))
    return explain_route(router, start, goal, blocked)
