"""`mapweave close`, `reopen`, `prefer`, `avoid` and `closures`: which ways robots may take, and should."""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import (
    add_area_options,
    add_plan_option,
    add_record_options,
    area_fields,
    record_of,
    two_numbers,
)
from mapweave.commands.answer import print_answer, print_said
from mapweave.commands.usage import UsageError, arguments_read
from mapweave.hybridmap.errors import InvalidValue

if TYPE_CHECKING:
    from mapweave.fleet import Fleet
    from mapweave.hybridmap.annotation import Annotation
    from mapweave.offline_record import OfflineRecord

WHERE = (
    "WHERE is two nodes with an edge between them (r0.1.17 r0.1.19), a named place, or a node or position "
    "with the floor around it (--radius, default: 1 m); or --corners."
)
TIMES = "14:00, '2026-03-01 14:00' (local time), '2026-03-01 14:00 UTC', +2h, +30min"


def add_to(commands: Any) -> None:
    """Declare the commands."""
    close: argparse.ArgumentParser = commands.add_parser(
        "close",
        help="close a way or an area to robots, for a time",
        description="Close an edge or an area: no route leads through it, robots on their way take another "
        f"one, and a goal within it is refused. {WHERE} Closing an edge closes all that crosses its middle. "
        "Examples: `mapweave close r0.1.17 r0.1.19 --until 14:00`, `mapweave close kitchen --because paint`.",
    )
    _add_where(close)
    close.add_argument("--from", dest="begin", metavar="TIME", help=f"from when on (default: now): {TIMES}")
    close.add_argument("--until", dest="end", metavar="TIME", help="until when (default: until `reopen`)")
    close.set_defaults(run=run_close)

    reopen: argparse.ArgumentParser = commands.add_parser(
        "reopen",
        help="withdraw a closure",
        description="Withdraw a closure by its name, or by what was closed: `mapweave reopen kitchen`, "
        "`mapweave reopen r0.1.17 r0.1.19`. `mapweave closures` lists the names.",
    )
    reopen.add_argument("where", nargs="+", metavar="NAME|NODE", help="the name, or the two nodes")
    add_plan_option(reopen)
    add_record_options(reopen, changes=True)
    reopen.set_defaults(run=lambda arguments: _withdraw(arguments, "closure"))

    for verb, factor, words in (("prefer", 0.5, "0.1 to 1"), ("avoid", 4.0, "1 to 100")):
        parser: argparse.ArgumentParser = commands.add_parser(
            verb,
            help=f"let robots {verb} a way or an area",
            description=f"Let robots {verb} an edge or an area where they can: its cost in routes is "
            f"multiplied by a factor. {WHERE} Example: `mapweave {verb} r0.1.17 r0.1.19`; "
            f"`mapweave {verb} r0.1.17 r0.1.19 --undo` withdraws it.",
        )
        _add_where(parser)
        parser.add_argument(
            "--factor", type=float, default=factor, metavar="F", help=f"{words} (default: {factor:g})"
        )
        parser.add_argument("--undo", action="store_true", help="take it back")
        parser.set_defaults(run=run_prefer, verb=verb)

    listing: argparse.ArgumentParser = commands.add_parser(
        "closures",
        help="what is closed, preferred and avoided",
        description="List closures and preferences that are not withdrawn, those to come and those that are "
        "over included: `mapweave closures`.",
    )
    add_record_options(listing, changes=False)
    listing.set_defaults(run=run_list)


def _add_where(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "where", nargs="*", type=values.node, metavar="WHERE", help="two nodes, a place, a node or a position"
    )
    add_area_options(parser)
    parser.add_argument("--name", type=values.title, help="its name (default: what is meant)")
    add_record_options(parser, changes=True)


def run_close(arguments: argparse.Namespace) -> int:
    """Close a way."""
    from mapweave.hybridmap.wall_time import local_words, read_time, utc_words

    _check_where(arguments)
    now_ns = time.time_ns()
    times: dict[str, Any] = {}
    for field, text, word in (("begin_ns", arguments.begin, "from"), ("end_ns", arguments.end, "until")):
        if text is not None:
            with arguments_read():
                times[field] = stamp_ns = read_time(text, now_ns, begin_ns=times.get("begin_ns", 0))
            print(
                f"{word} {local_words(stamp_ns)} ({utc_words(stamp_ns)})",
                file=sys.stderr if arguments.json else sys.stdout,
            )
    with record_of(arguments, changes=True) as record:
        name, fields = _meant(arguments, "closure", record)
        fields |= times
        said = record.annotate("closure", name, arguments.because, check=arguments.check, **fields)
    print_said(arguments, said)
    return 0


def run_prefer(arguments: argparse.Namespace) -> int:
    """Prefer or avoid a way, or withdraw that."""
    from mapweave.hybridmap.annotation import LEAST_FACTOR, MOST_FACTOR

    least, most = (LEAST_FACTOR, 1.0) if arguments.verb == "prefer" else (1.0, MOST_FACTOR)
    # Written so that NaN fails.
    if not least <= arguments.factor <= most or arguments.factor == 1.0:
        words = f"{LEAST_FACTOR:g} to 1 prefers a way, 1 to {MOST_FACTOR:g} avoids it, 1 itself does neither"
        raise UsageError(f"--factor {arguments.factor:g}: {words}")
    if arguments.undo:
        if not (arguments.where or arguments.corners or arguments.name):
            raise UsageError("say WHERE, or its --name; `mapweave closures` lists them")
        return _withdraw(arguments, "preference")
    _check_where(arguments)
    with record_of(arguments, changes=True) as record:
        name, fields = _meant(arguments, "preference", record)
        fields["factor"] = arguments.factor
        said = record.annotate("preference", name, arguments.because, check=arguments.check, **fields)
    print_said(arguments, said)
    return 0


def run_list(arguments: argparse.Namespace) -> int:
    """Print closures and preferences."""
    from mapweave.hybridmap.annotation import Closure, Preference
    from mapweave.mapserver.http.json_values import json_values

    with record_of(arguments) as record:
        said = record.annotations()
        entries = [entry for entry, _ in (*said.in_force(Closure), *said.in_force(Preference))]
        lines = [] if arguments.json else [_listed(record, entry) for entry in entries]
    values = {"annotations": [json_values(entry) for entry in entries]}
    print_answer(arguments, values, lines or ["nothing is closed, preferred or avoided"])
    return 0


def _listed(record: Fleet | OfflineRecord, entry: Annotation) -> str:
    """One line; it has no effect while a node of it takes no part in the map, which says why."""
    from mapweave.hybridmap.annotation import Closure, Preference
    from mapweave.hybridmap.query import ResolveRequest
    from mapweave.mapserver.annotation_effects import nodes_of

    body, note = entry.body, ""
    assert isinstance(body, Closure | Preference), "of these kinds"
    try:
        record.resolve(ResolveRequest(tuple(map(str, nodes_of(body)))))
    except InvalidValue as error:
        note = f"; without effect: {error}"
    state = "" if not isinstance(body, Closure) or body.holds(time.time_ns()) else ", not now"
    return f"{entry.words}{state}{note}"


def _withdraw(arguments: argparse.Namespace, kind: str) -> int:
    with record_of(arguments, changes=True) as record:
        names = _names(arguments, kind, record)
        said = [record.withdraw(kind, name, arguments.because, check=arguments.check) for name in names]
    print_said(arguments, *said)
    return 0


def _names(arguments: argparse.Namespace, kind: str, record: Fleet | OfflineRecord) -> list[str]:
    """The name that is given, or those of what is meant: an edge may have one for each direction."""
    if getattr(arguments, "name", None):
        return [arguments.name]
    where = arguments.where or getattr(arguments, "corners", None) or []
    if arguments.plan and any(map(two_numbers, where)):
        # The same numbers are another place in the merged map.
        return [_name([*where, "on", arguments.plan])]
    names = [_name(where), *([_name(where[::-1])] if len(where) == 2 else [])]
    said = record.annotations()
    return [name for name in names if said.last(kind, name) is not None] or names[:1]


def _name(where: Sequence[str]) -> str:
    """What is meant, as a name; of a longer one the beginning, and a number that no other has."""
    from mapweave.hybridmap.annotation import MAX_NAME

    name = " ".join(where)
    if len(name) <= MAX_NAME:
        return name
    return f"{name[: MAX_NAME - 9]} {hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _check_where(arguments: argparse.Namespace) -> None:
    """Look at WHERE before a server is asked.

    Raises:
        UsageError: nothing, or too much, is given.
    """
    where, fields = arguments.where, area_fields(arguments)
    if len(where) > 2 or bool(where) == ("corners" in fields) or (len(where) == 2 and "radius" in fields):
        raise UsageError("give two nodes, or one place, node or position, or --corners")
    if len(where) == 2 and where[0] == where[1]:
        raise UsageError(f"{where[0]} twice: an edge joins two different nodes")


def _meant(
    arguments: argparse.Namespace, kind: str, record: Fleet | OfflineRecord
) -> tuple[str, dict[str, Any]]:
    """Name and fields of what WHERE means; the name is that of the entry that it replaces, if any."""
    from mapweave.mapserver.annotation_words import AROUND

    where, fields = arguments.where, dict[str, Any](area_fields(arguments))
    if len(where) == 2:
        fields["edge"] = where
    elif where and record.annotations().last("place", where[0]) is not None:
        fields["place"] = where[0]
    elif where:
        fields["node"] = where[0]
        fields.setdefault("radius", AROUND)
    return _names(arguments, kind, record)[0], fields
