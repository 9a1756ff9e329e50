"""`mapweave map extract`: the robots' own maps of a journal, store or map file as map files."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from mapweave.commands.map_input import SOURCES, map_source
from mapweave.exit_status import DONE, FAILED, NO
from mapweave.hybridmap.counted import counted


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "extract",
        help="write every robot's own map of a journal, store or map file into a map file",
        description="Write every map that an agent's journal (NAME.sqlite), a server's store or a merged map "
        "file holds into a map file of its own, for example r0.3.mapweave. The agent or server must not be "
        "running. A file that is there already is never written over. Exit status: 4 if there is no map to "
        "write.",
    )
    parser.add_argument("source", type=map_source, metavar="FILE", help=SOURCES)
    parser.add_argument(
        "-o", "--out", type=Path, default=Path(), metavar="DIR", help="folder for the files (default: here)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write them, and print which; 1 if a part of a map could not be read, 4 if there is none to write."""
    from mapweave.map_extraction import extract_maps

    maps, lost, source = extract_maps(arguments.source, arguments.out)
    if arguments.json:
        rows = [
            {
                "map": str(extracted.map), "path": str(extracted.path) if extracted.path else None,
                "nodes": extracted.nodes, "edges": extracted.edges, "complaint": extracted.complaint,
            }
            for extracted in maps
        ]  # fmt: skip
        print(json.dumps({"maps": rows, "lost": lost}))
    else:
        for extracted in maps:
            content = (
                f"{counted(extracted.nodes, 'node')}, {counted(extracted.edges, 'edge')}"
                if extracted.path
                else "empty, not written"
            )
            print(f"{extracted.path or extracted.map}: {content}")
        if not maps:
            print(f"{source}: holds no map")
    for extracted in maps:
        if extracted.complaint:
            print(f"mapweave: {extracted.complaint}", file=sys.stderr)
    if lost:
        print(f"mapweave: {lost}", file=sys.stderr)
    if lost or any(extracted.complaint for extracted in maps):
        return FAILED
    return DONE if any(extracted.path for extracted in maps) else NO
