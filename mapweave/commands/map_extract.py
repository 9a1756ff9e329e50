"""`mapweave map extract`: the robots' own maps of a journal, store or map file as map files."""

import argparse
import sys
from pathlib import Path
from typing import Any

from mapweave.commands.answer import add_json, print_answer
from mapweave.commands.map_input import SOURCES, map_source
from mapweave.exit_status import DONE, FAILED, NO
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidValue


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
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write them, and print which; 1 if a part of a map could not be read, 4 if there is none to write."""
    from mapweave.hybridmap.hybrid_map import HybridMap
    from mapweave.mapserver.own_maps import maps_of
    from mapweave.opened_map import open_map
    from mapweave.storage.map_file import MapFile, write_map_file
    from mapweave.terminal import working

    with working("reading the map"):
        opened = open_map(arguments.source)
    maps, lost = maps_of(opened.content), opened.complaints.get(None, "")
    paths = {map_id: arguments.out / f"{map_id}.mapweave" for map_id in opened.maps}
    for path in paths.values():
        if path.exists():
            raise InvalidValue(f"{path}: is there already; choose another folder with -o")
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for map_id, path in paths.items():
        hybrid = maps.get(map_id, HybridMap())
        nodes, edges = len(hybrid.nodes), len(hybrid.edges)
        if nodes or edges:
            refused = {m: why for m, why in opened.content.refused_changes.items() if m == map_id}
            content = MapFile("agent", str(map_id), tuple(hybrid.contents()), refused_changes=refused)
            write_map_file(path, content)
        rows.append({
            "map": str(map_id), "path": str(path) if nodes or edges else None, "nodes": nodes, "edges": edges,
            "complaint": opened.complaints.get(map_id, ""),
        })  # fmt: skip
    lines = []
    for row in rows:
        words = f"{counted(row['nodes'], 'node')}, {counted(row['edges'], 'edge')}"
        lines.append(f"{row['path'] or row['map']}: {words if row['path'] else 'empty, not written'}")
    print_answer(arguments, {"maps": rows, "lost": lost}, lines or [f"{opened.path}: holds no map"])
    complaints = [*filter(None, (*(row["complaint"] for row in rows), lost))]
    for complaint in complaints:
        print(f"mapweave: {complaint}", file=sys.stderr)
    if complaints:
        return FAILED
    return DONE if any(row["path"] for row in rows) else NO
