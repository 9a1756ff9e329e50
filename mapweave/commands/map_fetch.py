"""`mapweave map fetch`: the merged map of a running server into a map file."""

import argparse
from pathlib import Path
from typing import Any

from mapweave.commands.answer import add_json, print_answer
from mapweave.commands.missions import fleet_of
from mapweave.commands.network import add_network


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "fetch",
        help="the merged map of a running server into a file",
        description="Write the merged map that a running server has now into a map file: "
        "`mapweave map fetch office.mapweave`. The fleet goes on; `mapweave map show` shows the file.",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="the map file")
    add_json(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Fetch and write."""
    from mapweave.storage.atomic_file import check_map_place, write_whole
    from mapweave.terminal import working

    check_map_place(arguments.out)
    # A server takes seconds to pack 1000 nodes.
    with fleet_of(arguments) as fleet, working("fetching the map"):
        content, data = fleet.map_and_bytes()
    write_whole(arguments.out, data)
    values = {"file": str(arguments.out), "title": content.title, "bytes": len(data)}
    print_answer(arguments, values, [f"{arguments.out}: {content.title}, {len(data) / 1e6:.1f} MB"])
    return 0
