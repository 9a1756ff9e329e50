"""`mapweave status`: what every robot of a running fleet is doing."""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, NoReturn

from mapweave.commands.annotating import add_plan_option
from mapweave.commands.missions import fleet_of
from mapweave.commands.network import add_network
from mapweave.hybridmap.errors import NotConnected

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import RenderableType
    from rich.table import Table

    from mapweave.fleet import Fleet
    from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
    from mapweave.hybridmap.floor_plan import PlacedPlan
    from mapweave.wire.log_messages import Scalar

COLUMNS = (
    "robot", "mission", "doing", "at", "last node", "links", "nodes", "battery", "unsent", "lag", "age",
    "trouble",
)  # fmt: skip
MAY_LACK = ("last node", "links", "battery", "lag", "trouble")
TROUBLE = COLUMNS.index("trouble")
SPARE = ("links", "last node", "battery")
"""Left out, the first first, of a terminal on which even cut columns find no room."""
NUMBERS = ("links", "nodes", "battery", "unsent", "lag")
LEAST = 9
"""Characters that a column of words keeps on a narrow terminal."""
EVERY = 0.5
"""Time between two looks, s."""
TABLE_EVERY = 5.0
"""Between two tables where there is no terminal, s."""
MOST_APART = 10
"""Robots that are listed below the table with the reason why their maps are not merged, or with a trouble."""

LONG_BEHIND = 5.0
"""s for which a server is behind the one that leads, from which on the time is said."""


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "status",
        help="what every robot is doing",
        description="List the robots of a running fleet: mission and how far it is, what each is doing, "
        "where it is in the merged map, its last node there and links of its map with others, battery (if "
        "its driver tells it), changes that no server has yet and for how long the server has known of one, "
        "the age of its last message, what is wrong at present; below, why maps are not merged. "
        "Example: `mapweave status --watch`. Without a map server the robots are asked themselves; what only "
        "a server knows is then left out.",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object; with --watch one a line")
    add_plan_option(parser)
    parser.add_argument("--watch", action="store_true",
        help="go on until interrupted: live on a terminal, else a table in 5 s",
    )  # fmt: skip
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask and print."""
    from rich.live import Live

    from mapweave.terminal import plain_or_terminal, stamped

    with fleet_of(arguments) as fleet:
        if arguments.json and arguments.watch:
            _watch_json(fleet, arguments)
        if arguments.json:
            _print_json(fleet.status(), _plan(fleet, arguments))
            return 0
        # A line a robot where another program reads.
        console = plain_or_terminal(stderr=False)
        if not arguments.watch:
            console.print(_shown(fleet.status(), console.width, _plan(fleet, arguments), fleet.servers()))
            return 0
        with Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext() as live:
            while True:
                try:
                    plan, servers = _plan(fleet, arguments), fleet.servers()
                    shown = _shown(fleet.status(), console.width, plan, servers)
                except NotConnected as error:  # it may come back
                    shown = str(error)
                if live is not None:
                    live.update(shown, refresh=True)
                else:
                    console.print(stamped("status"), highlight=False)
                    console.print(shown)
                time.sleep(EVERY if live is not None else TABLE_EVERY)


def _watch_json(fleet: Fleet, arguments: argparse.Namespace) -> NoReturn:
    """A line each time until interrupted; on stderr, once, why there is none for a while."""
    said = ""
    while True:
        try:
            _print_json(fleet.status(), _plan(fleet, arguments))
            said = ""
        except NotConnected as error:  # it may come back
            if str(error) != said:
                said = str(error)
                print(f"mapweave: {said}", file=sys.stderr, flush=True)
        time.sleep(EVERY)


def _plan(fleet: Fleet, arguments: argparse.Namespace) -> PlacedPlan | None:
    return None if arguments.plan is None else fleet.plans().plan(arguments.plan)


def _shown(
    status: FleetStatus, width: int, plan: PlacedPlan | None, servers: Sequence[Mapping[str, Scalar]]
) -> RenderableType:
    """The table, why maps are not merged, and which server leads."""
    from rich.console import Group
    from rich.text import Text

    if not status.robots:
        return "\n".join(("no robot is there", *leading(servers)))
    return Group(
        table(status, width, plan),
        *map(Text, (*troubles(status, width, plan), *apart(status), *leading(servers))),
    )


def leading(servers: Sequence[Mapping[str, Scalar]]) -> list[str]:
    """Lines that say which of the servers that share a store merges, how far the others are behind it, and
    which ones wait for their store.
    """
    from mapweave.connection import waits_for

    lines = sorted(filter(None, map(waits_for, servers)))
    servers = [one for one in servers if not waits_for(one)]
    stores = sum("leads" not in one for one in servers) + any("leads" in one for one in servers)
    if stores > 1:
        counts = sorted(int(one.get("constraints", 0)) for one in servers)
        apart = f"; constraints in force: {', '.join(map(str, counts))}" if counts[0] != counts[-1] else ""
        lines.append(f"{len(servers)} servers have {stores} stores, which do not exchange decisions{apart}")
    for one in sorted(servers, key=lambda server: str(server.get("name", ""))):
        name, leader = one.get("name", ""), one.get("leader", "")
        if one.get("merges_itself"):
            lines.append(f"server {name} merges itself: {one['merges_itself']}")
        elif one.get("leads") and len(servers) > 1:
            lines.append(f"server {name} leads")
        elif leader and not one.get("leads"):
            lines.append(f"server {name} follows {leader}, {_behind(one)}")
    return lines


def _behind(server: Mapping[str, Scalar]) -> str:
    """How far a server that follows another is behind it."""
    words, seconds = f"{server.get('behind', 0)} changes behind", float(server.get("unmerged_s", 0.0))
    since = f" for {seconds:.0f} s" if seconds >= LONG_BEHIND else ""
    return f"{words}{since}{': ' if server.get('delay') else ''}{server.get('delay', '')}"


def apart(status: FleetStatus) -> list[str]:
    """Lines that say why maps are not merged: at most `MOST_APART`, and how many more there are."""
    lines = [f"{one.robot} is not merged: {one.apart}" for one in _in_order(status) if one.apart]
    more = len(lines) - MOST_APART
    return [*lines[:MOST_APART], *([f"and {more} more"] if more > 0 else [])]


def troubles(status: FleetStatus, width: int, plan: PlacedPlan | None = None) -> list[str]:
    """Lines with the whole of each trouble that the table cuts: at most `MOST_APART`, and how many more."""
    rows = [cells(robot, plan) for robot in _in_order(status)]
    room = _widths(rows, width).get(TROUBLE, 0)
    lines = [f"{row[0]}: {row[TROUBLE]}" for row in rows if len(row[TROUBLE]) > room]
    more = len(lines) - MOST_APART
    return [*lines[:MOST_APART], *([f"and {more} more with a trouble"] if more > 0 else [])]


def table(status: FleetStatus, width: int, plan: PlacedPlan | None = None) -> Table:
    """One line a robot.

    Args:
        status: of the fleet.
        width: characters of a line; what is long is cut: words before places, and numbers never.
        plan: in the coordinates of which robots are; None: of the merged map.
    """
    from rich.table import Table
    from rich.text import Text

    rows = [cells(robot, plan) for robot in _in_order(status)]
    widths = _widths(rows, width)
    lines = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column, room in widths.items():
        lines.add_column(
            COLUMNS[column],
            justify="right" if COLUMNS[column] in NUMBERS else "left",
            no_wrap=True,
            width=room,
            overflow="ellipsis",
        )
    for row in rows:
        lines.add_row(*(Text(row[column]) for column in widths))
    return lines


def _widths(rows: Sequence[tuple[str, ...]], width: int) -> dict[int, int]:
    """Which columns are shown, and how wide."""
    # A column in which no robot has anything is left out: most have no battery, and no trouble.
    shown = [k for k, name in enumerate(COLUMNS) if name not in MAY_LACK or any(row[k] for row in rows)]
    widest = {k: max(len(row[k]) for row in (COLUMNS, *rows)) for k in shown}
    over = sum(widest.values()) + len(shown) - 1 - width
    for column in (COLUMNS.index(name) for name in ("trouble", "doing", "mission", "at")):
        if column in shown:
            cut = min(max(over, 0), max(widest[column] - LEAST, 0))
            widest[column], over = widest[column] - cut, over - cut
    for column in (COLUMNS.index(name) for name in SPARE):
        if over > 0 and column in shown:
            shown.remove(column)
            over -= widest[column] + 1
    return {column: widest[column] for column in shown}


def cells(robot: RobotEntry, plan: PlacedPlan | None = None) -> tuple[str, ...]:
    """A robot's line, see `COLUMNS`."""
    from mapweave.hybridmap.agent_status import SILENT

    status = robot.status
    age = f"{robot.age:.1f} s" + (" silent" if robot.age > SILENT else "")
    if not robot.alive:
        age = "gone" if status is None else f"gone {_roughly(robot.age)}"
    if status is None:
        known = _newest(robot), _links(robot), "", "", "", _lag(robot), age
        return robot.robot, "", "", "", *known, robot.over_quota or robot.accusation
    doing = status.status
    mission = ""
    if (report := status.mission) is not None:
        percent = f" {report.progress:.0%}" if report.order.node is not None and report.open else ""
        mission = f"{report.order.words} {report.state}{percent}"
    return (
        robot.robot,
        mission,
        doing.words,
        _place(robot, plan),
        _newest(robot),
        _links(robot),
        str(doing.nodes),
        "" if status.battery is None else f"{status.battery:.0%}",
        str(status.unsent),
        _lag(robot),
        age,
        robot.over_quota or robot.accusation or _own_trouble(robot),
    )


def _in_order(status: FleetStatus) -> list[RobotEntry]:
    """Robots by name, r2 before r10."""

    def order(robot: RobotEntry) -> list[tuple[int, str]]:
        parts = re.split("([0-9]+)", robot.robot)
        return [(int(part), "") if k % 2 else (0, part) for k, part in enumerate(parts)]

    return sorted(status.robots, key=order)


def _roughly(seconds: float) -> str:
    for unit, size in (("d", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def _own_trouble(robot: RobotEntry) -> str:
    """What the robot says is wrong at present: nothing of one that is gone."""
    if robot.status is None or not robot.alive:
        return ""
    words, age = robot.status.last_error, robot.status.error_age
    return f"{words} (for {age:.0f} s)" if words and age >= 1.0 else words


def _newest(robot: RobotEntry) -> str:
    return "" if robot.newest is None else str(robot.newest)


def _links(robot: RobotEntry) -> str:
    return "" if robot.newest is None else str(robot.links)


def _lag(robot: RobotEntry) -> str:
    return f"{robot.lag:.1f} s" if robot.missing else ""


def _place(robot: RobotEntry, plan: PlacedPlan | None) -> str:
    pose, status = robot.merged_from_robot, robot.status
    if pose is not None and plan is not None:
        on_plan = plan.pose(robot.component, pose)
        name = f", {robot.place}" if robot.place else ""
        if on_plan is None:
            return f"not on plan {plan.name}{name}"
        return f"{on_plan.x:z.2f},{on_plan.y:z.2f} {math.degrees(on_plan.heading):z.0f}°{name}"
    if pose is not None:
        part = f" in part {robot.component}" if robot.component > 0 else ""
        part += f", {robot.place}" if robot.place else ""
        part += f", floor {robot.floor}" if robot.floor else ""
        return f"{pose.x:z.2f},{pose.y:z.2f} {math.degrees(pose.heading):z.0f}°{part}"
    if status is not None and status.status.fix_node is not None:
        return f"near {status.status.fix_node}"
    return "unknown"


def _print_json(status: FleetStatus, plan: PlacedPlan | None) -> None:
    import json

    from mapweave.mapserver.http.json_values import json_values
    from mapweave.mapserver.plan_answers import status_on_plan

    print(json.dumps(json_values(status if plan is None else status_on_plan(status, plan))), flush=True)
