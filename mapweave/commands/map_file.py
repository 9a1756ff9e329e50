"""`mapweave map ACTION`: show, explain, merge and export maps."""

import argparse
from typing import Any

from mapweave.commands import (
    map_backup,
    map_constraint,
    map_diff,
    map_explain,
    map_export,
    map_extract,
    map_fetch,
    map_history,
    map_import,
    map_merge,
    map_photographs,
    map_pin,
    map_portal,
    map_route,
    map_show,
)


def add_to(commands: Any) -> None:
    """Declare the command and its actions."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "map",
        help="show, explain, merge, export and extract maps",
        description="Show, explain, correct, merge, fetch, back up, export and extract maps.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    for action in (
        map_show, map_diff, map_explain, map_route, map_history, map_constraint, map_pin, map_portal,
        map_merge, map_fetch, map_backup, map_export, map_extract, map_import, map_photographs,
    ):  # fmt: skip
        action.add_to(actions)
