"""`mapweave floor`: on which floor a map is."""

import argparse
from typing import Any

from mapweave.commands import values
from mapweave.commands.annotating import (
    add_near,
    add_plan_option,
    add_record_options,
    print_entries,
    record_of,
)
from mapweave.commands.answer import print_said
from mapweave.commands.usage import UsageError


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "floor",
        help="say on which floor a map is",
        description="Label the map of a node with its floor: `mapweave floor first r0.1.17`. Maps on "
        "different floors are never linked, so twin rooms above each other are kept apart; answers name the "
        "floor. Maps without a label are on the floor of those with which they have most in common. "
        "`mapweave floor --undo r0.1.17` withdraws the label; `mapweave floor list` lists all.",
    )
    parser.add_argument("label", nargs="?", type=values.title, metavar="NAME", help="of the floor")
    parser.add_argument(
        "node", type=values.node, metavar="NODE|PLACE|X,Y", help="any node of the map; `list` alone lists all"
    )
    parser.add_argument("--undo", action="store_true", help="take it back")
    add_near(parser)
    add_plan_option(parser)
    add_record_options(parser, changes=True)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Label a map, or withdraw its label."""
    from mapweave.commands.map_ends import noted
    from mapweave.hybridmap.annotation import Floor
    from mapweave.hybridmap.query import ResolveRequest
    from mapweave.mapserver.plan_answers import off_plan

    if (arguments.label, arguments.node, arguments.undo) == (None, "list", False):
        return print_entries(arguments, "floors", Floor, "no map has a label yet: mapweave floor NAME NODE")
    if (arguments.label is None) != arguments.undo:
        raise UsageError("give the name of a floor and a node; with --undo a node alone")
    with record_of(arguments, changes=True) as record:
        words, near, resolve = [arguments.node], arguments.near or "", noted(record.resolve)
        if arguments.plan is not None:
            words = off_plan(words, record.plans().plan(arguments.plan), near, resolve)
        floors = set(record.annotations().floors.values())
        node = resolve(ResolveRequest(tuple(words), near)).found[0].node
        name, because = str(node.map), arguments.because
        if arguments.undo:
            said = [record.withdraw("floor", name, because, check=arguments.check)]
        else:
            fields = {"node": str(node), "label": arguments.label}
            said = [record.annotate("floor", name, because, check=arguments.check, **fields)]
        floors.update(record.annotations().floors.values())
    # Of one floor alone there are no links to another.
    if arguments.map is not None and not arguments.check and len(floors) > 1:
        does = "may stand again" if arguments.undo else "fall"
        said.append(
            f"links between floors {does} when the file is merged again: mapweave map merge FILE -o OUT"
        )
    print_said(arguments, *said)
    return 0
