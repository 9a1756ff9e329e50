"""`mapweave map route`: the way from node to node, and why it leads so or why there is none."""

from __future__ import annotations

import argparse
import json
import sys
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import add_near, add_plan_option
from mapweave.commands.answer import add_json
from mapweave.commands.map_input import SOURCES, map_source, router_of
from mapweave.commands.network import add_network, add_timeout
from mapweave.exit_status import DONE, NO

if TYPE_CHECKING:
    from mapweave.hybridmap.explanation import RouteExplanation
    from mapweave.hybridmap.ids import NodeId
    from mapweave.mapserver.routes import Router
    from mapweave.merge.pose_graph.merged_map import MergedMap


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "route",
        help="the way from node to node, and why it leads so, or why there is none",
        description="Explain the route from one node or named place to another (r0.1.17 kitchen), step by "
        "step; why not a shorter one; or why there is no way at all: what of it cannot be driven, what is "
        "blocked, or which maps would have to be one. A running server is asked, or a map file. "
        "Exit status 0: there is a way; 4: there is none; 1: could not ask.",
    )
    parser.add_argument("start", metavar="START", help="a node, a named place, or a position")
    parser.add_argument("goal", metavar="GOAL", help="another one")
    parser.add_argument(
        "--blocked", nargs=2, action="append", default=[], metavar="NODE",
        help="as if a robot could not get through between these two; may be given again",
    )  # fmt: skip
    parser.add_argument(
        "--via",
        action="append",
        default=[],
        metavar="PLACE",
        help="pass this first: a node, a place or a position; may be given again, in the order of the way",
    )
    parser.add_argument("--map", type=map_source, metavar="FILE", help=f"of {SOURCES}; no server is asked")
    add_near(parser)
    add_plan_option(parser)
    parser.add_argument("--draw", type=values.png, metavar="PNG", help="draw the way on the map")
    add_json(parser)
    add_timeout(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask and print."""
    from mapweave.commands.map_ends import names_of, node_of, resolved
    from mapweave.commands.plan import plan_of, plan_place
    from mapweave.explanation_text import route_words
    from mapweave.extras import need
    from mapweave.hybridmap.explanation import route_over
    from mapweave.mapserver.http.json_values import json_values
    from mapweave.mapserver.plan_answers import nodes_on_plan, off_plan

    if arguments.draw is not None:
        need("viz")
    stops = [arguments.start, *arguments.via, arguments.goal]
    words = [*stops, *(word for pair in arguments.blocked for word in pair)]
    router = None if arguments.map is None else router_of(arguments)
    plan, resolve = plan_of(arguments, router), names_of(arguments, router)[1]
    near = arguments.near or ""
    if plan is not None:
        words = off_plan(words, plan, near, resolve)
    nodes = list(map(node_of, resolved(arguments, words, router, near)))
    rest = nodes[len(stops) :]
    blocked = tuple(zip(rest[::2], rest[1::2], strict=True))
    legs = [_explained(arguments, router, *ends, blocked) for ends in pairwise(nodes[: len(stops)])]
    explanation = route_over(legs)
    values, on_plan = json_values(explanation), None
    if plan is not None:
        way = (explanation.start, *(hop.b for hop in explanation.hops))
        poses = nodes_on_plan(way, plan, resolve)
        values["stops"] = [
            {"node": str(node), "plan_from_node": json_values(pose)}
            for node, pose in zip(way, poses, strict=True)
        ]
        on_plan = [plan_place(plan, pose) for pose in poses]
    lines = route_words(explanation, on_plan)
    if arguments.draw is not None and explanation.found:
        draw_route(arguments, None if router is None else router.merged, explanation)
        values["picture"] = str(arguments.draw)
        lines.append(f"  picture   {arguments.draw}")
    print(json.dumps(values) if arguments.json else "\n".join(lines))
    if arguments.draw is not None and not explanation.found:
        print(f"{arguments.draw} is not drawn: there is no way", file=sys.stderr)
    return DONE if explanation.found else NO


def draw_route(
    arguments: argparse.Namespace, merged: MergedMap | None, explanation: RouteExplanation
) -> None:
    """Draw a way on the part of the map through which it leads."""
    import numpy as np

    from mapweave.commands.map_ends import ask
    from mapweave.drawing.map_picture import DrawnDrive, MapPicture, draw_map
    from mapweave.hybridmap.hybrid_map import HybridMap
    from mapweave.mapserver.map_files import map_file_of
    from mapweave.storage.map_file import unpack_map_file
    from mapweave.wire.keys import Keys

    if merged is None:
        content = unpack_map_file(ask(arguments, Keys.any_server_map, b"")[0].payload)
    else:
        content = map_file_of(merged)
    part, _ = content.poses[explanation.start]
    poses = {node: p.mean for node, (number, p) in content.poses.items() if number == part}
    stops = (explanation.start, *(hop.b for hop in explanation.hops))
    # Beyond a portal it leads through another part.
    way = [poses[node] for node in stops if node in poses]
    places = np.array([[pose.x, pose.y] for pose in way])
    drive = DrawnDrive(places, way[0], way[-1], "the way", begun="start")
    title = f"{explanation.start} to {explanation.goal}\n{explanation.reason}"
    edges = list(HybridMap(content.changes).edges.values())
    draw_map(MapPicture(title, poses, edges, drives=[drive]), arguments.draw)


def _explained(
    arguments: argparse.Namespace,
    router: Router | None,
    start: NodeId,
    goal: NodeId,
    blocked: tuple[tuple[NodeId, NodeId], ...],
) -> RouteExplanation:
    from mapweave.commands.map_ends import explanation_of
    from mapweave.hybridmap.explanation import RouteExplanation
    from mapweave.hybridmap.query import ExplainRequest

    explanation = explanation_of(arguments, ExplainRequest((start, goal), True, blocked), router)
    assert isinstance(explanation, RouteExplanation), "a route was asked about"
    return explanation
