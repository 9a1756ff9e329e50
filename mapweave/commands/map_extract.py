"""`mapweave map extract`: map files of what can still be read of a damaged store."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "extract",
        help="save what can be read of a damaged store",
        description="Write a map file of each robot's map in a map server's store (.sqlite), from the "
        "changes that can be read and are what was written. The store stays as it is. A server whose store "
        "is damaged as a whole starts again when the file is moved away: robots send again what they keep. "
        "`mapweave map merge` merges the map files of robots that are gone.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="a store: s0.sqlite in the server's folder")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FOLDER", help="for the map files")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the maps, and say what is missing."""
    from mapserver.log.salvage import salvage
    from wire.mapfile import MapFile, write_map_file

    found = salvage(arguments.file)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for map_id, hybrid in sorted(found.maps.items()):
        path = arguments.out / f"{map_id}.mapweave"
        write_map_file(path, MapFile("agent", f"{map_id}, extracted", tuple(hybrid.contents())))
        print(f"{path}: {len(hybrid.nodes)} nodes, {len(hybrid.edges)} edges")
    if found.damaged or not found.whole:
        lost = f"{found.damaged} damaged changes" if found.damaged else "no damaged change"
        pages = (
            "" if found.whole else ", and pages that cannot be read: how many changes they had is not known"
        )
        print(f"mapweave: {arguments.file} had {lost}{pages}", file=sys.stderr)
    return 0
