"""Rulings on the command line: their options, and how a server or a file is told."""

from __future__ import annotations

import argparse
import getpass
import time
from pathlib import Path
from typing import TYPE_CHECKING

from mapweave.commands.network import add_network

if TYPE_CHECKING:
    from mapweave.hybridmap.manual_constraint import Ends, ManualConstraint


def add_ruling(parser: argparse.ArgumentParser) -> None:
    """Declare what every ruling may be given."""
    parser.add_argument("--because", default="", metavar="TEXT", help="why; for those who wonder later")
    parser.add_argument("--by", metavar="NAME", help="who says so (default: the name you are logged in by)")
    parser.add_argument("--undo", action="store_true", help="take it back")
    parser.add_argument("--map", type=Path, metavar="FILE", help="in this map file; no server is asked")
    parser.add_argument("-o", "--out", type=Path, metavar="OUT", help="with --map: write there instead")
    parser.add_argument("--timeout", type=float, default=20.0, metavar="S", help="longest wait for an answer")
    add_network(parser)


def rule(arguments: argparse.Namespace, ends: Ends) -> None:
    """Rule, and say what has come of it; afterwards `arguments.map` is the file that holds it.

    Raises:
        MapweaveError: there is nothing to rule, or nobody who would keep it.
    """
    from mapweave.hybridmap.errors import InvalidValue
    from mapweave.hybridmap.manual_constraint import ManualConstraint

    if arguments.out is not None and arguments.map is None:
        raise InvalidValue("--out goes with --map: what a server is told it keeps itself")
    ruling = ManualConstraint(
        ends, not arguments.undo, arguments.by or _login(), time.time_ns(), arguments.because
    )
    if arguments.map is None:
        _tell_server(arguments, ruling)
    else:
        _rewrite(arguments, ruling)
        arguments.map = arguments.out or arguments.map


def _login() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # nobody of that number is known to the machine
        return "somebody"


def _tell_server(arguments: argparse.Namespace, ruling: ManualConstraint) -> None:
    from mapweave.commands.map_ends import ask
    from mapweave.wire.keys import Keys
    from mapweave.wire.log_messages import decode_record
    from mapweave.wire.messages import encode

    for reply in ask(arguments, Keys.any_rule, encode(ruling)):
        print(decode_record(reply.payload)["said"])
    _settled(arguments)


def _settled(arguments: argparse.Namespace) -> None:
    """Wait until the server has merged with it, or the time is over."""
    from mapweave.commands.map_ends import ask
    from mapweave.wire.keys import Keys
    from mapweave.wire.log_messages import decode_record

    end = time.monotonic() + arguments.timeout
    while time.monotonic() < end:
        if all(
            decode_record(reply.payload)["settled"] for reply in ask(arguments, Keys.server_statuses, b"")
        ):
            return
        time.sleep(0.1)
    print("it is kept; the server is still merging, ask `mapweave map explain` later")


def _rewrite(arguments: argparse.Namespace, ruling: ManualConstraint) -> None:
    from mapweave.commands.map_merge import merged_with_progress
    from mapweave.commands.network import settings_of
    from mapweave.hybridmap.manual_constraint import ManualConstraints
    from mapweave.mapserver.map_files import map_file_of, merged_of
    from mapweave.mapserver.map_history import between
    from mapweave.merge.manual_constraints import check_manual_constraint
    from mapweave.offline_merge import parts_of
    from mapweave.storage.atomic_file import check_place
    from mapweave.storage.map_file import read_map_file, write_map_file

    check_place(arguments.out or arguments.map)
    settings = settings_of(arguments).merge
    content = read_map_file(arguments.map, "merged")
    before = merged_of(content, settings)
    check_manual_constraint(before, ManualConstraints(content.rulings), ruling)
    parts = parts_of({arguments.map: content})
    merged = merged_with_progress(parts.maps, parts.rulings + ManualConstraints([ruling]), settings)
    out = arguments.out or arguments.map
    history = (*parts.history, *between(before, merged, ruling.stamp_ns))
    write_map_file(out, map_file_of(merged, history))
    print(f"{out}: {merged.summary()}")
