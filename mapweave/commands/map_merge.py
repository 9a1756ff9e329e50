"""`mapweave map merge`: map files become one, without a server."""

import argparse
from pathlib import Path
from typing import Any

from mapweave.commands.answer import print_answer
from mapweave.commands.map_input import SOURCES, map_source, merge_progress, opened
from mapweave.commands.network import settings_of


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "merge",
        help="merge map files without a server",
        description="Merge map files as the map server does: robots' own maps, or merged ones, which are "
        "taken apart and merged again; stores and journals are read alike. Of an older and a newer file of "
        "one map the newer counts. Manual constraints in any of them hold. The result does not depend on the "
        "order of the files.",
    )
    parser.add_argument("files", type=map_source, nargs="+", metavar="FILE", help=SOURCES)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="the merged map's file")
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object")
    parser.add_argument(
        "--settings", type=Path, metavar="FILE", help="TOML; [merge] says which links are accepted"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Merge, write, print the outcome."""
    from mapweave.mapserver.map_files import map_file_of
    from mapweave.merge.explanation.component_changes import joinings
    from mapweave.merge.explanation.map_explanation import explain_fleet
    from mapweave.offline_merge import parts_of
    from mapweave.storage.atomic_file import check_map_place
    from mapweave.storage.map_file import write_map_file

    check_map_place(arguments.out)
    settings = settings_of(arguments).merge
    parts = parts_of({one.path: one.content for one in map(opened, arguments.files)})
    with merge_progress() as report:
        merged = parts.merged(settings, report)
    write_map_file(arguments.out, map_file_of(merged, parts.history, parts.annotations, parts.images))
    joined = joinings((), merged)
    apart = [explanation.reason for explanation in explain_fleet(merged, 20) if not explanation.joined]
    outcome = {
        "out": str(arguments.out),
        "nodes": len(merged.poses),
        "maps": [str(explanation) for explanation in merged.maps],
        "components": len(merged.components),
        "links": sum(not link.within for link in merged.links),
        "loops": sum(link.within for link in merged.links),
        "refused": sum(refusal.link is not None for refusal in merged.refused),
        "notes": list(parts.notes),
        "joined": list(joined),
        "apart": apart,
    }
    more = [f"  {words}" for words in (*parts.notes, *joined, *apart)]
    print_answer(arguments, outcome, [f"{arguments.out}: {merged.summary()}", *more])
    return 0
