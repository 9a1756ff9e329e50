"""`mapweave map link`, `unmerge`, `retire` and `undo`: manual constraints, which reach a server or a file."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import add_plan_option, record_of
from mapweave.commands.answer import add_json, print_answer, print_said
from mapweave.commands.map_input import SOURCES, map_source
from mapweave.commands.network import add_network, add_reason, add_timeout
from mapweave.commands.plan import plan_of
from mapweave.commands.usage import UsageError, arguments_read
from mapweave.hybridmap.errors import MapweaveError

if TYPE_CHECKING:
    from mapweave.fleet import Fleet
    from mapweave.fleet_questions import FleetQuestions
    from mapweave.hybridmap.constraint_subject import RetiredArea, RetiredWindow, Subject
    from mapweave.offline_record import OfflineRecord

PATIENT = 2.0
"""s; who waits longer hears what for."""


def add_to(actions: Any) -> None:
    """Declare the actions."""
    for add in (_add_link, _add_unmerge, _add_retire, _add_undo):
        add(actions)


def add_constraint_options(parser: argparse.ArgumentParser, undo: bool = True) -> None:
    """Declare the options of every manual constraint."""
    add_reason(parser)
    if undo:
        parser.add_argument("--undo", action="store_true", help="take it back")
    parser.add_argument("--check", action="store_true", help="only say what it would do; change nothing")
    add_json(parser)
    parser.add_argument(
        "--map", type=map_source, metavar="FILE", help=f"in {SOURCES}; no server is asked, and only a merged "
        "map file is changed",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--out", type=Path, metavar="OUT", help="with --map: write a map file there instead"
    )
    add_timeout(parser, of="a merge with it")
    add_network(parser)


def constrain(
    arguments: argparse.Namespace,
    record: Fleet | OfflineRecord,
    about: Subject,
    more: Callable[[], Sequence[str]] = tuple,
) -> None:
    """Set the constraint, and print its effect and its number, by which `mapweave map undo` takes it back.

    With `--check` only print.

    Args:
        arguments: of the command.
        record: of the map.
        about: what the constraint is about.
        more: further lines, asked for when it is set.

    Raises:
        MapweaveError: the constraint has no effect, or there is no place to keep it.
    """
    from mapweave.fleet_questions import FleetQuestions

    with arguments_read():
        request = record.request(about, not arguments.undo, arguments.because, arguments.check)
    said, number = record.keep(request).splitlines(), None
    if not arguments.check:
        key = request.constraint.stamp_ns, request.constraint.holds
        made = enumerate(record.constraints(), 1)
        number = next((k for k, one in made if (one.stamp_ns, one.holds) == key), None)
        if isinstance(record, FleetQuestions):
            said += _settled(record, arguments.timeout)
    if number is not None and not arguments.undo:
        said[0] += f" (number {number})"
    print_said(arguments, *said, *more(), number=number)


def _settled(fleet: FleetQuestions, timeout: float) -> list[str]:
    """Wait until the servers have merged with it; what is to be said if the time is over."""
    begin, heard = time.monotonic(), False
    while (waited := time.monotonic() - begin) < timeout:
        if waited > PATIENT and not heard:
            heard = True
            print("waiting until the server has merged with it ...", file=sys.stderr, flush=True)
        if all(server["settled"] for server in fleet.servers()):
            return []
        time.sleep(0.1)
    return ["it is kept; the server is still merging, ask `mapweave map explain` later"]


def _add_link(actions: Any) -> None:
    parser: argparse.ArgumentParser = actions.add_parser(
        "link",
        help="link two nodes by hand: they see one place",
        description="Link two nodes (r0.1.17 r1.1.5) that see one place, of two maps or of one. Their images "
        "say how they lie to each other. Where these do not agree, that is refused with the evidence, unless "
        "you give the pose yourself (--pose) and say why (--because). What contradicts the merged map, or "
        "puts two robots in one place at one time, is refused with the figures and with what to undo first. "
        "The link stays, whatever robots map later; what contradicts it then is in `mapweave map history`.",
    )
    parser.add_argument("nodes", nargs=2, metavar="NODE|PLACE", help="the two nodes")
    parser.add_argument(
        "--pose", metavar="X,Y,DEGREES",
        help="the second node seen from the first: m ahead, m left, heading; if negative, --pose=-1,0,90",
    )  # fmt: skip
    add_constraint_options(parser)
    parser.set_defaults(run=run_link)


def run_link(arguments: argparse.Namespace) -> int:
    """Link two nodes."""
    from mapweave.commands.map_ends import check_ids, nodes_of, noted
    from mapweave.hybridmap.constraint_subject import Linked, read_pose
    from mapweave.hybridmap.named_nodes import own_ids_of

    pose = None
    if arguments.pose is not None:
        try:
            numbers = [float(word) for word in arguments.pose.split(",")]
        except ValueError:
            raise UsageError(f"--pose {arguments.pose!r}: give X,Y,DEGREES, for example 1.5,0,90") from None
        with arguments_read():
            pose = read_pose(numbers)
    check_ids(arguments.nodes, nodes_of)
    try:
        with record_of(arguments, changes=True) as record:
            a, b = nodes_of(own_ids_of(arguments.nodes, record.annotations, noted(record.resolve)))
            with arguments_read():
                about = Linked(a, b, pose)
            constrain(arguments, record, about)
    except MapweaveError as error:
        from mapweave.merge.link_checks import GIVE_POSE

        # The refusal is the same on the page, where an option of the shell means nothing.
        if GIVE_POSE not in str(error):
            raise
        raise type(error)(f"{error}: --pose X,Y,DEGREES --because TEXT") from None
    return 0


def _add_unmerge(actions: Any) -> None:
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
    parser.set_defaults(run=run_unmerge)


def run_unmerge(arguments: argparse.Namespace) -> int:
    """Undo a link, or all links between two maps."""
    from mapweave.commands.map_ends import check_ids, different_ends_of, noted
    from mapweave.hybridmap.constraint_subject import Apart
    from mapweave.hybridmap.explanation import FleetExplanation
    from mapweave.hybridmap.ids import MapId
    from mapweave.hybridmap.named_nodes import own_ids_of
    from mapweave.hybridmap.query import ExplainRequest

    check_ids(arguments.ends, different_ends_of)
    with record_of(arguments, changes=True) as record:
        ends = different_ends_of(own_ids_of(arguments.ends, record.annotations, noted(record.resolve)))
        first, second = (MapId(end[0], end[1]) for end in ends)

        def reasons() -> list[str]:
            found = record.explained(ExplainRequest((first, second)))
            assert isinstance(found, FleetExplanation), "maps were asked about"
            return [explanation.reason for explanation in found.maps]

        constrain(arguments, record, Apart(ends), reasons if first != second else list)
    return 0


def _add_retire(actions: Any) -> None:
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
        help='what lies in a polygon in the frame of a node, m: --area r0.1.17 "0,-1 2,-1 2,1 0,1"; '
        "with --plan on the plan, under the part of the map where the node is",
    )  # fmt: skip
    parser.add_argument("--from", dest="begin", type=values.given, metavar="TIME",
                        help="nodes of the map from then on: 2026-03-01T12:00, or ns")  # fmt: skip
    parser.add_argument("--until", dest="end", type=values.given, metavar="TIME", help="until then")
    add_plan_option(parser)
    add_constraint_options(parser)
    parser.set_defaults(run=run_retire)


def run_retire(arguments: argparse.Namespace) -> int:
    """Retire maps, nodes, areas or times."""
    in_time = bool(arguments.begin or arguments.end)
    if (arguments.area is not None) == bool(arguments.which) or (in_time and len(arguments.which) != 1):
        raise UsageError("give a map or nodes, or --area; --from and --until go with one map")
    if arguments.plan is not None and arguments.area is None:
        raise UsageError("--plan goes with --area")
    from mapweave.commands.map_ends import check_ids, noted
    from mapweave.hybridmap.area import read_corner
    from mapweave.hybridmap.constraint_subject import read_retired
    from mapweave.hybridmap.named_nodes import retired_of

    about: Subject | None = None
    with arguments_read():
        corners = [] if arguments.area is None else list(map(read_corner, arguments.area[1].split()))
        if in_time:
            about = _window(arguments)
    if arguments.which:
        check_ids(arguments.which, read_retired)
    with record_of(arguments, changes=True) as record:
        if about is None:
            with arguments_read():
                about = (
                    retired_of(arguments.which, record.annotations, noted(record.resolve))
                    if arguments.area is None
                    else _area(arguments, record, corners)
                )
        constrain(arguments, record, about)
    return 0


def _window(arguments: argparse.Namespace) -> RetiredWindow:
    from mapweave.commands.map_ends import map_of
    from mapweave.hybridmap.constraint_subject import read_window

    which, now = map_of(arguments.which[0]), time.time_ns()
    if arguments.begin and arguments.end:
        begin = read_window(which, arguments.begin, "", now, None).begin_ns
        end = read_window(which, "", arguments.end, now, None).end_ns
        if begin > end:
            raise UsageError(f"--until {arguments.end} is before --from {arguments.begin}")
    return read_window(which, arguments.begin or "", arguments.end or "", now, None)


def _area(
    arguments: argparse.Namespace, record: Fleet | OfflineRecord, corners: list[tuple[float, float]]
) -> RetiredArea:
    from mapweave.commands.map_ends import node_of, noted
    from mapweave.hybridmap.area import Area
    from mapweave.hybridmap.constraint_subject import RetiredArea
    from mapweave.hybridmap.named_nodes import own_ids_of
    from mapweave.hybridmap.query import ResolveRequest
    from mapweave.mapserver.plan_answers import in_merged

    resolve = noted(record.resolve)
    (node,) = map(node_of, own_ids_of([arguments.area[0]], record.annotations, resolve))
    placed = plan_of(arguments, record)
    if placed is None:
        return RetiredArea(Area(node, tuple(corners)))
    (found,) = resolve(ResolveRequest((str(node),))).found
    part = placed.part(found.component)
    merged = [in_merged(corner, part) for corner in corners]
    return RetiredArea(Area.of_merged(found.node, found.merged_from_node, merged))


def _add_undo(actions: Any) -> None:
    parser: argparse.ArgumentParser = actions.add_parser(
        "undo",
        help="list what people have linked, unmerged and retired, and take it back",
        description="List the manual constraints that hold, each with its number; with a number take that "
        "one back: `mapweave map undo 3`. Nothing is deleted: the record keeps who did what, when and why.",
    )
    parser.add_argument("number", nargs="?", type=int, metavar="NUMBER", help="take this one back")
    add_constraint_options(parser, undo=False)
    parser.set_defaults(run=run_undo, undo=True)


def run_undo(arguments: argparse.Namespace) -> int:
    """List the constraints that hold, or take one back."""
    from mapweave.hybridmap.manual_constraint import ManualConstraints, event_words, to_take_back
    from mapweave.mapserver.http.json_values import constraint_values
    from mapweave.refusals import refusals

    with record_of(arguments, changes=arguments.number is not None) as record:
        made = record.constraints()
        if arguments.number is not None:
            with refusals():
                about = to_take_back(made, arguments.number)
            constrain(arguments, record, about)
            return 0
    known = ManualConstraints(made)
    lines = [f"{k:4}  {event_words(c)}" for k, c in enumerate(made, 1) if c in known.in_force]
    print_answer(arguments, constraint_values(known), lines or ["no manual constraint holds"])
    return 0
