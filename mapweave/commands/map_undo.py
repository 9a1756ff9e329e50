"""`mapweave map undo`: which manual constraints hold, and taking one back by its number."""

from __future__ import annotations

import argparse
import json
from typing import Any

from mapweave.commands.map_constraint import add_constraint_options, constrain, constraints_of


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "undo",
        help="list what people have linked, unmerged and retired, and take it back",
        description="List the manual constraints that hold, each with its number; with a number take that "
        "one back: `mapweave map undo 3`. Nothing is deleted: the record keeps who did what, when and why.",
    )
    parser.add_argument("number", nargs="?", type=int, metavar="NUMBER", help="take this one back")
    add_constraint_options(parser, undo=False)
    parser.set_defaults(run=run, undo=True)


def run(arguments: argparse.Namespace) -> int:
    """List, or take back."""
    from mapweave.hybridmap.manual_constraint import event_words, to_take_back
    from mapweave.mapserver.http.json_values import constraint_values
    from mapweave.refusals import refusals

    record = constraints_of(arguments)
    if arguments.number is not None:
        with refusals():
            about = to_take_back(record.made, arguments.number)
        constrain(arguments, about)
        return 0
    if arguments.json:
        print(json.dumps(constraint_values(record)))
        return 0
    holding = record.in_force
    lines = [f"{k:4}  {event_words(c)}" for k, c in enumerate(record.made, 1) if c in holding]
    print("\n".join(lines) or "no manual constraint holds")
    return 0
