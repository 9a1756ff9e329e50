"""`mapweave map retire`: maps, nodes, areas or times take no part in anything any more; or do again."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.map_constraint import add_constraint_options, constrain
from mapweave.commands.usage import UsageError, arguments_read

if TYPE_CHECKING:
    from mapweave.hybridmap.constraint_subject import Subject


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "retire",
        help="retire a map, nodes, an area or a time window: they take no part in anything",
        description="Retire a map (r0.1), some nodes (r0.1.17 r0.1.18), an area (its name, or --area), or "
        "what a map has of a time (r0.1 --from --until): it takes no part in the merge any more, no route "
        "leads through it, and no view is recognised by it. Nothing is deleted: it is retired until that is "
        "taken back with --undo or `mapweave map undo`, also when robots map on and the server starts "
        "again; nodes that come into an area or a time window later are retired too. A robot's own way "
        "keeps tying what lies before and behind a retired node; --check says beforehand whether a map "
        "falls into pieces. What robots map again need not be retired: newer nodes replace the older "
        "ones by themselves.",
    )
    parser.add_argument(
        "which", nargs="*", metavar="MAP|NODE|PLACE",
        help="one map, as r0.1, or nodes, as r0.1.17, or the name of an area, of which all nodes are retired",
    )  # fmt: skip
    parser.add_argument(
        "--area", nargs=2, metavar=("NODE|PLACE", "CORNERS"),
        help='what lies in a polygon in the frame of a node, m: --area r0.1.17 "0,-1 2,-1 2,1 0,1"',
    )  # fmt: skip
    parser.add_argument("--from", dest="begin", type=values.given, metavar="TIME",
                        help="nodes of the map from then on: 2026-03-01T12:00, or ns")  # fmt: skip
    parser.add_argument("--until", dest="end", type=values.given, metavar="TIME", help="until then")
    add_constraint_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Set the constraint, and print its effect."""
    constrain(arguments, _subject(arguments))
    return 0


def _subject(arguments: argparse.Namespace) -> Subject:
    from mapweave.commands.map_ends import map_of, names_of, node_of
    from mapweave.hybridmap.area import Area, read_corner
    from mapweave.hybridmap.constraint_subject import RetiredArea, read_window
    from mapweave.hybridmap.named_nodes import own_ids_of, retired_of

    in_time = bool(arguments.begin or arguments.end)
    if (arguments.area is not None) == bool(arguments.which) or (in_time and len(arguments.which) != 1):
        raise UsageError("give a map or nodes, or --area; --from and --until go with one map")
    with arguments_read():
        if arguments.area is not None:
            anchor, corners = arguments.area
            (node,) = map(node_of, own_ids_of([anchor], *names_of(arguments)))
            return RetiredArea(Area(node, tuple(map(read_corner, corners.split()))))
        if in_time:
            which, now = map_of(arguments.which[0]), time.time_ns()
            if arguments.begin and arguments.end:
                begin = read_window(which, arguments.begin, "", now, None).begin_ns
                end = read_window(which, "", arguments.end, now, None).end_ns
                if begin > end:
                    raise UsageError(f"--until {arguments.end} is before --from {arguments.begin}")
            return read_window(which, arguments.begin or "", arguments.end or "", now, None)
        return retired_of(arguments.which, *names_of(arguments))
