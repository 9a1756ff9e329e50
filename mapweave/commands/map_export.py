"""`mapweave map export`: a map file for others' tools."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from mapweave.commands.map_input import SOURCES, merged_with_progress, opened

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
    parser.add_argument("file", type=Path, metavar="FILE", help=SOURCES)
    parser.add_argument("--to", choices=FORMATS, required=True, help="format")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="file, or folder (tum)")
    parser.add_argument(
        "--component",
        type=int,
        default=0,
        metavar="N",
        help="which part that is one (default: 0, the largest)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write, and print what was written and what was left out."""
    from mapweave.formats.export import FORMATS as WRITERS
    from mapweave.formats.map_part import MapPart

    merged = merged_with_progress(opened(arguments.file))
    part = MapPart(merged, arguments.component)
    for path in WRITERS[arguments.to](part, arguments.out):
        print(path)
    left = len(merged.poses) - len(part.nodes)
    if left:
        words = f"component {part.component} of {len(merged.components)}: {left} nodes of others are left out"
        print(
            f"mapweave: {words}; they have frames of their own, choose one with --component", file=sys.stderr
        )
    return 0
