"""`mapweave map history`: joins, splits and manual constraints, with dates."""

import argparse
from typing import Any

from mapweave.commands.annotating import record_of
from mapweave.commands.answer import print_answer
from mapweave.commands.map_input import SOURCES, map_source
from mapweave.commands.network import add_network
from mapweave.commands.usage import UsageError


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "history",
        help="joins, splits and manual constraints, with dates",
        description="List the history of the maps that a running server keeps, oldest first: which became "
        "one, which came apart and what took their links away, which are kept apart since two robots cannot "
        "have been where their links put them; constraints, annotations, and who has sent, stopped or driven "
        "which robot. The server keeps the newest 500 on its disk, the newest 1000 commands, and every "
        "constraint and annotation; a map file (--map) has the history until it was written, no commands.",
    )
    parser.add_argument("--map", type=map_source, metavar="FILE", help=f"of {SOURCES}; no server is asked")
    parser.add_argument("--most", type=int, default=40, metavar="N", help="the newest so many (default: 40)")
    parser.add_argument("--json", action="store_true", help="print one JSON object, with all")
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask and print."""
    from mapweave.hybridmap.map_event import History
    from mapweave.mapserver.http.json_values import json_values, time_of

    if arguments.most < 1:
        raise UsageError(f"--most {arguments.most}: give 1 or more")
    with record_of(arguments) as record:
        events = History(tuple(record.history()))
    listed = events.history
    left_out = len(listed) - arguments.most
    lines = [f"({left_out} older ones: --most)"] if left_out > 0 else []
    lines += [f"{time_of(h.stamp_ns)} UTC  {h.kind:11}  {h.words}" for h in listed[-arguments.most :]]
    nothing = "no joins, splits, manual constraints, annotations or commands yet"
    print_answer(arguments, json_values(events), lines or [nothing])
    return 0
