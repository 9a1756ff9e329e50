"""Manual constraints on the command line: their options, and how they reach a server or a file."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mapweave.commands.annotating import print_said
from mapweave.commands.map_input import SOURCES, map_source, merge_progress, merged_with_progress, opened
from mapweave.commands.network import (
    add_network,
    add_reason,
    add_timeout,
    key_holder,
    network_of,
    settings_of,
)
from mapweave.commands.usage import UsageError, arguments_read
from mapweave.hybridmap.errors import InvalidFile

if TYPE_CHECKING:
    from mapweave.hybridmap.constraint_subject import Subject
    from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint, ManualConstraints

PATIENT = 2.0
"""s; who waits longer hears what for."""


def add_constraint_options(parser: argparse.ArgumentParser, undo: bool = True) -> None:
    """Declare the options of every manual constraint."""
    add_reason(parser)
    if undo:
        parser.add_argument("--undo", action="store_true", help="take it back")
    parser.add_argument("--check", action="store_true", help="only say what it would do; change nothing")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--map", type=map_source, metavar="FILE", help=f"in {SOURCES}; no server is asked, and only a merged "
        "map file is changed",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--out", type=Path, metavar="OUT", help="with --map: write a map file there instead"
    )
    add_timeout(parser)
    add_network(parser)


def constrain(
    arguments: argparse.Namespace, about: Subject, more: Callable[[], Sequence[str]] = tuple
) -> None:
    """Set the constraint, and print its effect and its number, by which `mapweave map undo` takes it back.

    Afterwards `arguments.map` is the file that holds it. With `--check` only print.

    Args:
        arguments: of the command.
        about: what the constraint is about.
        more: further lines, asked for when it is set.

    Raises:
        MapweaveError: the constraint has no effect, or there is no place to keep it.
    """
    from mapweave.fleet import author
    from mapweave.fleet_questions import check_role
    from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint

    if arguments.out is not None and arguments.map is None:
        raise UsageError("--out goes with --map: a server keeps its own record")
    holder = None if arguments.map is not None else key_holder(network_of(arguments, settings_of(arguments)))
    check_role(holder)
    by = author(holder, arguments.by)
    with arguments_read():
        constraint = ManualConstraint(about, not arguments.undo, by, time.time_ns(), arguments.because)
        request = ConstraintRequest(constraint, arguments.check)
    if arguments.map is None:
        said = _send_to_server(arguments, request, "" if holder is None else holder.name)
    else:
        said = _rewrite(arguments, constraint)
        arguments.map = arguments.map if arguments.check else arguments.out or arguments.map
    number = None if arguments.check else _number(arguments, constraint)
    if number is not None and constraint.holds:
        said[0] += f" (number {number})"
    print_said(arguments, *said, *more(), number=number)


def _number(arguments: argparse.Namespace, constraint: ManualConstraint) -> int | None:
    """Which of the record it is, from 1."""
    made = constraints_of(arguments).made
    key = constraint.stamp_ns, constraint.holds
    return next((k for k, one in enumerate(made, 1) if (one.stamp_ns, one.holds) == key), None)


def constraints_of(arguments: argparse.Namespace) -> ManualConstraints:
    """The record of a map file or of a server; the first is number 1."""
    from mapweave.commands.map_ends import ask
    from mapweave.hybridmap.manual_constraint import ConstraintList, ManualConstraints
    from mapweave.wire.keys import Keys
    from mapweave.wire.messages import decode

    if arguments.map is not None:
        return ManualConstraints(opened(arguments.map).content.constraints)
    return ManualConstraints(
        decode(ask(arguments, Keys.any_constraints, b"")[0].payload, ConstraintList).made
    )


def _send_to_server(arguments: argparse.Namespace, request: ConstraintRequest, sender: str) -> list[str]:
    from mapweave.commands.map_ends import ask
    from mapweave.wire.log_messages import decode_record
    from mapweave.wire.messages import encode
    from mapweave.wire.senders import sent_by

    replies = ask(arguments, lambda keys: sent_by(keys.any_constrain(), sender), encode(request))
    said = [str(decode_record(reply.payload)["said"]) for reply in replies]
    return said if arguments.check else said + _settled(arguments)


def _settled(arguments: argparse.Namespace) -> list[str]:
    """Wait until the server has merged with it; what is to be said if the time is over."""
    from mapweave.commands.map_ends import ask
    from mapweave.wire.keys import Keys
    from mapweave.wire.log_messages import decode_record

    begin, heard = time.monotonic(), False
    while (waited := time.monotonic() - begin) < arguments.timeout:
        if waited > PATIENT and not heard:
            heard = True
            print("waiting until the server has merged with it ...", file=sys.stderr, flush=True)
        if all(
            decode_record(reply.payload)["settled"] for reply in ask(arguments, Keys.server_statuses, b"")
        ):
            return []
        time.sleep(0.1)
    return ["it is kept; the server is still merging, ask `mapweave map explain` later"]


def _rewrite(arguments: argparse.Namespace, constraint: ManualConstraint) -> list[str]:
    from mapweave.offline_constraints import CHECKED, checked_constraint, with_constraint
    from mapweave.opened_map import MapSource
    from mapweave.storage.atomic_file import check_place

    settings = settings_of(arguments).merge
    one = opened(arguments.map)
    content, of_file = one.content, one.source is MapSource.FILE
    out = arguments.out
    if content.kind == "merged":
        out = out or Path(arguments.map)
    elif out is None and not arguments.check:
        kind = "a map file of kind agent, not merged," if of_file else one.source.words
        raise InvalidFile(
            f"{one.path}: is {kind} and is not changed: give -o FILE for a merged map with the constraint"
            f"{'' if of_file else ', or ask the running server without --map'}"
        )
    if out is not None:
        check_place(out)
    before = merged_with_progress(one, settings)
    constraint, words = checked_constraint(content, before, constraint, settings)
    if arguments.check:
        return [CHECKED + words]
    assert out is not None
    with merge_progress() as report:
        merged, file = with_constraint(one, before, constraint, settings, report)
    one.written(out, file)
    return [words, f"{out}: {merged.summary()}"]
