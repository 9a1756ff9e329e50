"""`mapweave map portal`: lifts, ramps and doors through which robots ask to be taken."""

import argparse
from typing import Any

from mapweave.commands import values
from mapweave.commands.annotating import (
    add_near,
    add_plan_option,
    add_record_options,
    add_remove,
    print_entries,
    record_of,
)
from mapweave.commands.answer import print_said
from mapweave.commands.usage import UsageError

KINDS = ("lift", "ramp", "door")


def add_to(actions: Any) -> None:
    """Declare the action and its own actions."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "portal",
        help="lifts, ramps and doors through which people take robots",
        description="Portals join parts of the map between which no robot drives by itself. A route may lead "
        "through them; the robot parks at one side and asks. See also `mapweave portal done`.",
    )
    steps = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    add: argparse.ArgumentParser = steps.add_parser(
        "add",
        help="add a lift, a ramp or a door",
        description="Add a portal between two nodes, or named places. Robots park at them as at goals. A "
        "lift and a ramp lead from one floor to another: label both with `mapweave floor`. The same name "
        "again: the later one holds.",
    )
    add.add_argument(
        "name", type=values.title, metavar="NAME", help="1 to 64 characters, for example 'east lift'"
    )
    add.add_argument("a", type=values.node, metavar="A", help="node, place or position at one side")
    add.add_argument("b", type=values.node, metavar="B", help="at the other side")
    add.add_argument("--kind", choices=KINDS, required=True, help="what it is")
    add.add_argument(
        "--note", type=values.note, default="", metavar="TEXT", help="for who takes a robot through"
    )
    add_near(add)
    add_plan_option(add)
    add_record_options(add, changes=True)
    add.set_defaults(run=run_add)

    portals: argparse.ArgumentParser = steps.add_parser(
        "list", help="all portals", description="List the portals: `mapweave map portal list`."
    )
    add_record_options(portals, changes=False)
    portals.set_defaults(run=run_list)

    add_remove(
        steps, "portal", "remove a portal", "of the portal",
        "Remove a portal: `mapweave map portal remove 'east lift'`. `mapweave map history` still "
        "shows it; `map portal add` brings it back. For a time: `mapweave close A B`.",
    )  # fmt: skip


def run_add(arguments: argparse.Namespace) -> int:
    """Add a portal."""
    a = arguments
    if a.a == a.b:
        raise UsageError(f"{a.a} twice: a portal leads from one node to another")
    with record_of(a, changes=True) as record:
        given = {name: said for name in ("near", "plan") if (said := getattr(a, name))}
        fields = {"a": a.a, "b": a.b, "means": a.kind, "note": a.note, **given}
        said = record.annotate("portal", a.name, a.because, check=a.check, **fields)
    print_said(a, said)
    return 0


def run_list(arguments: argparse.Namespace) -> int:
    """Print the portals."""
    from mapweave.hybridmap.portal import Portal

    none = "there is no portal yet: mapweave map portal add NAME A B --kind lift"
    return print_entries(arguments, "portals", Portal, none)
