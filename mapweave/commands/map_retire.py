"""`mapweave map retire`: a map takes no part in anything any more; or does again."""

from __future__ import annotations

import argparse
from typing import Any

from mapweave.commands.map_constraint import add_constraint_options, constrain


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "retire",
        help="retire a map: it takes no part in the merge, in routes and in answers",
        description="Retire a map (r0.1): it takes no part in the merge any more, no route leads through it, "
        "and no view is recognised by it. Nothing is deleted: it is retired until that is taken back with "
        "--undo, also when its robot maps on and the server starts again. Who did so, when and why is shown "
        "by `mapweave map explain`. What robots map again need not be retired: newer nodes replace the "
        "older ones by themselves.",
    )
    parser.add_argument("which", metavar="MAP", help="the map, as r0.1: a robot and its epoch")
    add_constraint_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Set the constraint, and print its effect."""
    from mapweave.commands.map_ends import map_of

    which = map_of(arguments.which)
    constrain(arguments, (which, which))
    return 0
