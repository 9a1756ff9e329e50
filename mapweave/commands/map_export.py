"""`mapweave map export`: a map file for others' tools."""

import argparse
import sys
from pathlib import Path
from typing import Any

from mapweave.commands.annotating import add_plan_option
from mapweave.commands.answer import add_json, print_said
from mapweave.commands.map_input import SOURCES, map_source, merged_with_progress, opened
from mapweave.hybridmap.counted import counted

FORMATS = ("g2o", "tum", "graphml", "geojson")


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "export",
        help="write a map for others' tools",
        description="Write one component of a map: its pose graph (g2o), each robot's places over time "
        "(tum: a file, or a folder if there are several robots), places and edges (graphml), or a route "
        "graph that Nav2's route server loads (geojson).",
    )
    parser.add_argument("file", type=map_source, metavar="FILE", help=SOURCES)
    parser.add_argument("--format", choices=FORMATS, required=True, help="format")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="file, or folder (tum)")
    parser.add_argument(
        "--component",
        type=int,
        metavar="N",
        help="which part that is one (default: 0, the largest; with --plan that with most pairs)",
    )
    add_plan_option(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write, and print what was written and what was left out."""
    from mapweave.formats.export import FORMATS as WRITERS
    from mapweave.formats.map_part import MapPart
    from mapweave.hybridmap.annotation import Annotations
    from mapweave.mapserver.floor_plans import placed_plans

    source = opened(arguments.file)
    merged = merged_with_progress(source)
    part = MapPart(merged, arguments.component or 0)
    if arguments.plan is not None:
        plans = placed_plans(Annotations(source.content.annotations), merged)
        placed = plans.plan(arguments.plan).part(arguments.component)
        part = MapPart(merged, placed.component, placed.plan_from_merged)
    written = list(map(str, WRITERS[arguments.format](part, arguments.out)))
    left = len(merged.poses) - len(part.nodes)
    if left:
        others = f"{counted(left, 'node')} of others {'is' if left == 1 else 'are'} left out"
        words = f"component {part.component} of {len(merged.components)}: {others}"
        print(
            f"mapweave: {words}; they have frames of their own, choose one with --component", file=sys.stderr
        )
    nodes = len(part.nodes)
    print_said(
        arguments, "\n".join(written), files=written, component=part.component, nodes=nodes, left_out=left
    )
    return 0
