"""What people say about the map, on the command line: the options, and how it reaches a server or a file."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.answer import add_json, print_answer, print_said
from mapweave.commands.map_input import SOURCES, map_source, merge_progress, opened
from mapweave.commands.missions import fleet_of
from mapweave.commands.network import add_network, add_reason, key_holder, network_of, settings_of
from mapweave.commands.usage import UsageError
from mapweave.hybridmap.errors import InvalidValue, Refused

if TYPE_CHECKING:
    from mapweave.fleet import Fleet
    from mapweave.hybridmap.annotation import Body
    from mapweave.offline_record import OfflineRecord


def add_record_options(parser: argparse.ArgumentParser, changes: bool) -> None:
    """Declare options.

    Args:
        parser: of the command.
        changes: whether the command adds to the record.
    """
    if changes:
        add_reason(parser)
        parser.add_argument("--check", action="store_true", help="only say what it would do; change nothing")
        parser.add_argument(
            "-o", "--out", type=Path, metavar="OUT", help="with --map: write a map file there instead"
        )
    add_json(parser)
    parser.add_argument("--map", type=map_source, metavar="FILE", help=f"of {SOURCES}; no server is asked")
    add_network(parser)


def add_area_options(parser: argparse.ArgumentParser) -> None:
    """Declare how an area is given."""
    parser.add_argument("--radius", type=float, metavar="M", help="the floor so far around, m")
    parser.add_argument(
        "--corners", nargs="+", metavar="X,Y", help="the floor within these corners in the merged map, m"
    )
    add_near(parser)
    add_plan_option(parser)


def add_plan_option(parser: argparse.ArgumentParser) -> None:
    """Declare `--plan` of commands that take or give coordinates."""
    parser.add_argument("--plan", metavar="NAME", help="in the coordinates of this floor plan")


def add_near(parser: argparse.ArgumentParser) -> None:
    """Declare in which part of the map positions are."""
    parser.add_argument(
        "--near", type=values.node, metavar="NODE|PLACE",
        help="positions are in the part of the map where this is (default: the largest part)",
    )  # fmt: skip


def add_remove(actions: Any, kind: str, words: str, of: str, description: str) -> None:
    """Declare the action that withdraws an annotation of a kind by its name."""

    def run(arguments: argparse.Namespace) -> int:
        with record_of(arguments, changes=True) as record:
            said = record.withdraw(kind, arguments.name, arguments.because, check=arguments.check)
        print_said(arguments, said)
        return 0

    remove: argparse.ArgumentParser = actions.add_parser("remove", help=words, description=description)
    remove.add_argument("name", metavar="NAME", help=of)
    add_record_options(remove, changes=True)
    remove.set_defaults(run=run)


def print_entries(arguments: argparse.Namespace, title: str, kind: type[Body], none: str) -> int:
    """Print the annotations of a kind that are in force, or that there are none; the exit status."""
    from mapweave.mapserver.http.json_values import json_values

    with record_of(arguments) as record:
        entries = [entry for entry, _ in record.annotations().in_force(kind)]
    values = {title: [json_values(entry) for entry in entries]}
    print_answer(arguments, values, [entry.words for entry in entries] or [none])
    return 0


def area_fields(arguments: argparse.Namespace) -> dict[str, object]:
    """The options of `add_area_options` as fields of an annotation.

    Raises:
        UsageError: a corner is no position, there are too few or too many, their outline crosses itself, or
            the radius is no length.
    """
    from mapweave.hybridmap.area import FARTHEST, LEAST_CORNERS, MOST_CORNERS, check_outline

    fields: dict[str, object] = {}
    if arguments.radius is not None:
        # Written so that NaN fails.
        if not 0.0 < arguments.radius < FARTHEST:
            raise UsageError(
                f"--radius {arguments.radius:g}: give metres, more than 0 and less than {FARTHEST:g}"
            )
        fields["radius"] = arguments.radius
    if arguments.corners:
        corners = [two_numbers(word) for word in arguments.corners]
        if None in corners or not LEAST_CORNERS <= len(corners) <= MOST_CORNERS:
            many = f"{LEAST_CORNERS} to {MOST_CORNERS}"
            raise UsageError(f"--corners: give {many} positions, as 3.1,-2.0 4,-2 4,1.5")
        try:
            check_outline([corner for corner in corners if corner is not None])
        except InvalidValue as error:
            raise UsageError(f"--corners: {error}") from None
        fields["corners"] = corners
    return fields | {name: said for name in ("near", "plan") if (said := getattr(arguments, name))}


def two_numbers(word: str) -> tuple[float, float] | None:
    """A position or a pixel; None for what is neither."""
    from mapweave.mapserver.places import position_of

    try:
        return position_of(word)
    except InvalidValue:
        return None


@contextmanager
def record_of(arguments: argparse.Namespace, changes: bool = False) -> Iterator[Fleet | OfflineRecord]:
    """The fleet that the command line names, or the map of `--map`: both answer the same questions.

    Args:
        arguments: of the command.
        changes: whether the command changes what people say about the map: not everyone's key may.

    Raises:
        MapweaveError: no server answers, the key may only look, or the file cannot be read.
    """
    from mapweave.fleet_questions import check_role
    from mapweave.login import login

    try:
        if arguments.map is None:
            if getattr(arguments, "out", None) is not None:
                raise UsageError("--out goes with --map: a server keeps its own record")
            if changes:
                check_role(key_holder(network_of(arguments, settings_of(arguments))))
            with fleet_of(arguments) as fleet:
                yield fleet
        else:
            from mapweave.offline_record import OfflineRecord

            by, out = getattr(arguments, "by", "") or login(), getattr(arguments, "out", None)
            settings = settings_of(arguments).merge
            yield OfflineRecord(opened(arguments.map), out, by, settings, merge_progress)
    except Refused as error:
        # The refusal is the same on the page, where an option of the shell means nothing.
        if not str(error).endswith("needs a reason"):
            raise
        raise Refused(f"{error}: --because TEXT") from None
