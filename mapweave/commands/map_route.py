"""`mapweave map route`: the way from node to node, and why it leads so or why there is none."""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import add_near, add_plan_option, record_of
from mapweave.commands.answer import add_json, print_answer
from mapweave.commands.map_input import SOURCES, map_source
from mapweave.commands.network import add_network
from mapweave.exit_status import DONE, NO

if TYPE_CHECKING:
    from mapweave.hybridmap.explanation import RouteExplanation
    from mapweave.storage.map_file import MapFile


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
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask and print."""
    from mapweave.commands.map_ends import check_ids, nodes_of, noted
    from mapweave.commands.plan import plan_of, plan_place
    from mapweave.explanation_text import route_words, with_node
    from mapweave.extras import need
    from mapweave.hybridmap.explanation import RouteExplanation, route_over
    from mapweave.hybridmap.named_nodes import ids_of
    from mapweave.hybridmap.query import ExplainRequest
    from mapweave.mapserver.http.json_values import json_values
    from mapweave.mapserver.plan_answers import nodes_on_plan, off_plan

    if arguments.draw is not None:
        need("viz")
    stops = [arguments.start, *arguments.via, arguments.goal]
    words = [*stops, *(word for pair in arguments.blocked for word in pair)]
    near = arguments.near or ""
    check_ids(words, nodes_of)
    with record_of(arguments) as record:
        plan, resolve = plan_of(arguments, record), noted(record.resolve)
        if plan is not None:
            words = off_plan(words, plan, near, resolve)
        nodes = nodes_of(ids_of(words, resolve, near))
        rest = nodes[len(stops) :]
        blocked = tuple(zip(rest[::2], rest[1::2], strict=True))
        asked = [ExplainRequest(ends, True, blocked) for ends in pairwise(nodes[: len(stops)])]
        legs = [leg for leg in map(record.explained, asked) if isinstance(leg, RouteExplanation)]
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
        start, *via, goal = map(with_node, stops, nodes)
        passing = f" via {', '.join(via)}" if via else ""
        lines = route_words(explanation, on_plan, f"{start} to {goal}{passing}")
        if arguments.draw is not None and explanation.found:
            draw_route(arguments.draw, record.map(), explanation)
            values["picture"] = str(arguments.draw)
            lines.append(f"  picture   {arguments.draw}")
    print_answer(arguments, values, lines)
    if arguments.draw is not None and not explanation.found:
        print(f"{arguments.draw} is not drawn: there is no way", file=sys.stderr)
    return DONE if explanation.found else NO


def draw_route(out: Path, content: MapFile, explanation: RouteExplanation) -> None:
    """Draw a way on the part of the map through which it leads."""
    import numpy as np

    from mapweave.drawing.map_picture import DrawnDrive, MapPicture, draw_map
    from mapweave.hybridmap.hybrid_map import HybridMap

    part, _ = content.poses[explanation.start]
    poses = {node: p.mean for node, (number, p) in content.poses.items() if number == part}
    stops = (explanation.start, *(hop.b for hop in explanation.hops))
    # Beyond a portal it leads through another part.
    way = [poses[node] for node in stops if node in poses]
    places = np.array([[pose.x, pose.y] for pose in way])
    drive = DrawnDrive(places, way[0], way[-1], "the way", begun="start")
    title = f"{explanation.start} to {explanation.goal}\n{explanation.reason}"
    edges = list(HybridMap(content.changes).edges.values())
    draw_map(MapPicture(title, poses, edges, drives=[drive]), out)
