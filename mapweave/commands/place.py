"""`mapweave place`: names for places of the map."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import (
    add_area_options,
    add_record_options,
    add_remove,
    area_fields,
    record_of,
)
from mapweave.commands.answer import print_answer, print_said
from mapweave.commands.usage import UsageError, arguments_read
from mapweave.hybridmap.errors import InvalidValue

if TYPE_CHECKING:
    from mapweave.fleet import Fleet
    from mapweave.hybridmap.annotation import Annotation
    from mapweave.offline_record import OfflineRecord

EXAMPLES = "Examples: `mapweave place add kitchen r0.1.17`, `mapweave go r0 kitchen`."


def add_to(commands: Any) -> None:
    """Declare the command and its actions."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "place",
        help="name places; list and remove names",
        description="Names for places of the merged map. A name stands wherever a node may stand: in `go`, "
        f"`map route`, `map explain`. {EXAMPLES}",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    add: argparse.ArgumentParser = actions.add_parser(
        "add",
        help="name a node, or an area",
        description="Name a place: a node, the node nearest to a position, or an area. A place moves with "
        f"the map when the merge changes. The same name again: the later one holds. {EXAMPLES} "
        "`mapweave place add hall 2.0,1.5 --radius 3`, "
        "`mapweave place add office --corners 0,0 4,0 4,3 0,3`.",
    )
    add.add_argument(
        "name", type=values.title, metavar="NAME",
        help="1 to 64 characters; not a node, a map, a position or home",
    )  # fmt: skip
    add.add_argument(
        "where", nargs="?", type=values.node, metavar="NODE|X,Y",
        help="a node, a position in the merged map, m, or a place",
    )  # fmt: skip
    add_area_options(add)
    add_record_options(add, changes=True)
    add.set_defaults(run=run_add)

    names: argparse.ArgumentParser = actions.add_parser(
        "list", help="all named places", description="List the named places: `mapweave place list`."
    )
    add_record_options(names, changes=False)
    names.set_defaults(run=run_list)

    add_remove(
        actions, "place", "remove a name", "of the place",
        "Remove the name of a place: `mapweave place remove kitchen`. `mapweave map history` "
        "still shows it; `place add` brings it back.",
    )  # fmt: skip


def run_add(arguments: argparse.Namespace) -> int:
    """Name a place."""
    from mapweave.hybridmap.annotation import check_place_name

    with arguments_read():
        check_place_name(arguments.name)
    fields = area_fields(arguments)
    if (arguments.where is None) == ("corners" not in fields):
        raise UsageError("give a node, a position, or --corners")
    if arguments.where is not None:
        fields["node"] = arguments.where
    with record_of(arguments, changes=True) as record:
        said = record.annotate("place", arguments.name, arguments.because, check=arguments.check, **fields)
    print_said(arguments, said)
    return 0


def run_list(arguments: argparse.Namespace) -> int:
    """Print the places."""
    from mapweave.hybridmap.annotation import Place
    from mapweave.mapserver.http.json_values import json_values

    with record_of(arguments) as record:
        places = [(entry, *_where(record, entry)) for entry, _ in record.annotations().in_force(Place)]
    width, lines = max((len(entry.name) for entry, _, _ in places), default=0), []
    for entry, _, note in places:
        said = f" ({entry.because})" if entry.because else ""
        lines.append(f"{entry.name:<{width}}  {entry.body.words}{said}, by {entry.who or 'a person'}")
        lines += [f"{'':<{width}}  {note}"] if note else []
    values = {"places": [{**json_values(entry), "at": at, "note": note} for entry, at, note in places]}
    print_answer(arguments, values, lines or ["no place has a name yet: mapweave place add NAME NODE"])
    return 0


def _where(record: Fleet | OfflineRecord, entry: Annotation) -> tuple[str | None, str]:
    """The node to which robots go, and what is to be said about it; None if there is none."""
    from mapweave.hybridmap.query import ResolveRequest

    try:
        found = record.resolve(ResolveRequest((entry.name,))).found[0]
    except InvalidValue as error:
        return None, str(error)
    return str(found.node), found.note
