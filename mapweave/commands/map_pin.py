"""`mapweave map pin`: a node keeps its pose, so that the merged frame never jumps."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import add_plan_option, add_record_options, record_of
from mapweave.commands.answer import print_answer, print_said
from mapweave.commands.plan import plan_place
from mapweave.commands.usage import UsageError
from mapweave.hybridmap.errors import InvalidValue

if TYPE_CHECKING:
    from mapweave.fleet import Fleet
    from mapweave.hybridmap.floor_plan import PlacedPlan
    from mapweave.hybridmap.ids import NodeId
    from mapweave.hybridmap.pose import Pose2
    from mapweave.offline_record import OfflineRecord


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "pin",
        help="keep the frame of a part of the map by the pose of a node",
        description="Pin a node: the part of the map in which it is keeps its frame, also when others join "
        "it: `mapweave map pin r0.1.17`. With a pose (x,y in m, heading in degrees) the part is moved there: "
        "`mapweave map pin r0.1.17 12.5,-3,90`; with --plan to where the node is on a floor plan, so that "
        "the part has the coordinates of the plan: `mapweave map pin r0.1.17 --plan office`. Where two "
        "pinned parts join, the older pin holds, and `mapweave map history` says by which transform the "
        "other frame has moved. Without NODE the pins are listed.",
    )
    parser.add_argument("node", nargs="?", type=values.node, metavar="NODE|PLACE", help="a node, or a place")
    parser.add_argument("pose", nargs="?", metavar="X,Y,DEGREES", help="its pose (default: as it is now)")
    parser.add_argument("--undo", action="store_true", help="take the pin out")
    add_plan_option(parser)
    add_record_options(parser, changes=True)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Pin a node, take a pin out, or list them."""
    from mapweave.commands.map_ends import noted
    from mapweave.hybridmap.named_nodes import ids_of
    from mapweave.hybridmap.query import ResolveRequest

    if arguments.node is None:
        if arguments.undo:
            raise UsageError("name the node whose pin is taken out")
        return _list(arguments)
    if None not in (arguments.plan, arguments.pose):
        raise UsageError("--plan says where the node is on the plan: leave the pose out")
    fields: dict[str, Any] = {} if arguments.plan is None else {"plan": arguments.plan}
    if arguments.pose is not None:
        fields["merged_from_node"] = _pose(arguments.pose)
    with record_of(arguments, changes=True) as record:
        resolve = noted(record.resolve)
        if arguments.undo:
            # A retired node is found by its id alone.
            (node,) = ids_of([arguments.node], resolve)
            said = record.withdraw("pin", node, arguments.because, check=arguments.check)
        else:
            node = str(resolve(ResolveRequest((arguments.node,))).found[0].node)
            fields["node"] = node
            said = record.annotate("pin", node, arguments.because, check=arguments.check, **fields)
    print_said(arguments, said)
    return 0


def _list(arguments: argparse.Namespace) -> int:
    from mapweave.hybridmap.pin import Pin
    from mapweave.mapserver.http.json_values import json_values

    with record_of(arguments) as record:
        pins = sorted(record.annotations().in_force(Pin), key=lambda item: item[0].stamp_ns)
        placed = None if arguments.plan is None else record.plans().plan(arguments.plan)
        at = [None if placed is None else _on_plan(record, pin.node, placed) for _, pin in pins]
    values, lines = [], []
    for (entry, pin), pose in zip(pins, at, strict=True):
        on_plan = {} if placed is None else {"plan_from_node": json_values(pose)}
        values.append({**json_values(entry), **on_plan})
        where = pin.words if placed is None else plan_place(placed, pose)
        said = f" ({entry.because})" if entry.because else ""
        lines.append(f"{pin.node} {where}{said}, by {entry.who or 'a person'}")
    print_answer(arguments, {"pins": values}, lines or ["nothing is pinned: mapweave map pin NODE"])
    return 0


def _on_plan(record: Fleet | OfflineRecord, node: NodeId, placed: PlacedPlan) -> Pose2 | None:
    """Where a node is on a plan; None if it is on neither the plan nor the merged map now."""
    from mapweave.mapserver.plan_answers import nodes_on_plan

    try:
        return nodes_on_plan([node], placed, record.resolve)[0]
    except InvalidValue:
        return None


def _pose(word: str) -> list[float]:
    """`12.5,-3,90` as m, m, rad.

    Raises:
        UsageError: it is no pose.
    """
    from mapweave.hybridmap.pin import FARTHEST

    try:
        x, y, degrees = map(float, word.split(","))
    except ValueError:
        x = y = degrees = math.nan
    # Written so that NaN fails.
    if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and abs(degrees) <= 360.0):
        raise UsageError(f"pose {word!r}: give x,y,heading, m and degrees, for example 12.5,-3,90")
    return [x, y, math.radians(degrees)]
