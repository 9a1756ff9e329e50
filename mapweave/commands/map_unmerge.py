"""`mapweave map unmerge`: two nodes, or two maps, shall not be linked; or may be again."""

from __future__ import annotations

import argparse
from typing import Any

from mapweave.commands.map_constraint import add_constraint_options, constrain


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "unmerge",
        help="undo a link, or all links between two maps",
        description="Undo the link between two nodes (r0.1.17 r1.1.5), or all links between two maps "
        "(r0.1 r1.1), those to come included. It stays undone, also when robots map on and the server starts "
        "again, until it is withdrawn with --undo. Who did so, when and why is kept and shown by "
        "`mapweave map explain`.",
    )
    parser.add_argument(
        "ends", nargs="+", metavar="NODE|PLACE|MAP", help="the link: two nodes or places, or two maps"
    )
    add_constraint_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Set the constraint, and print its effect."""
    from mapweave.commands.map_ends import different_ends_of, explanation_of, names_of
    from mapweave.hybridmap.constraint_subject import Apart
    from mapweave.hybridmap.explanation import FleetExplanation
    from mapweave.hybridmap.ids import MapId
    from mapweave.hybridmap.named_nodes import own_ids_of
    from mapweave.hybridmap.query import ExplainRequest

    ends = different_ends_of(own_ids_of(arguments.ends, *names_of(arguments)))
    first, second = (MapId(end[0], end[1]) for end in ends)

    def reasons() -> list[str]:
        found = explanation_of(arguments, ExplainRequest((first, second)))
        assert isinstance(found, FleetExplanation), "maps were asked about"
        return [explanation.reason for explanation in found.maps]

    constrain(arguments, Apart(ends), reasons if first != second else list)
    return 0
