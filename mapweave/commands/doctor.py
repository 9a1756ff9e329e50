"""`mapweave doctor`: examine a robot, and name the first thing that is wrong."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.agent import take_robot_file
from mapweave.commands.network import add_network, network_of
from mapweave.commands.value_completion import complete_drivers
from mapweave.exit_status import DONE, NO

if TYPE_CHECKING:
    from rich.console import Console

    from mapweave.agent.drivers.robot import Robot
    from mapweave.doctor.finding import Finding
    from mapweave.settings import Settings
    from mapweave.wire.bus import Bus

NARROW = 72
"""Characters of a line below which a table would break words."""
SUBJECT = 14
"""Characters of the longest subject but one of a port."""
STYLES = {"good": "green", "warning": "yellow", "wrong": "bold red", "skipped": "dim"}


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "doctor",
        help="examine a robot, and name the first thing that is wrong",
        description="Examine libraries, clock, disk, calibration, camera, driver, encoders and server, and "
        "name the first thing that is wrong with what to do about it. Exit status 4 if something is wrong. "
        "Runs even where libraries are missing. The robot moves only with --drive.",
    )
    robot = parser.add_argument(
        "--robot",
        metavar="DRIVER|FILE",
        help="its driver, FILE.py:CLASS, or its settings file, FILE.toml, as of `agent` (default: the driver "
        "of --settings)",
    )
    complete_drivers(robot)
    parser.add_argument("--name", type=values.name, help="of the robot in the fleet (default: r0)")
    parser.add_argument(
        "--data",
        type=Path,
        default=Path("out/agents"),
        help="folder for the robot's map (default: out/agents)",
    )
    parser.add_argument(
        "--drive", action="store_true",
        help="let the robot drive 20 cm forward and turn 45 degrees, to compare encoders and image; else you "
        "are asked to push it",
    )  # fmt: skip
    parser.add_argument("--offline", action="store_true", help="leave out the server")
    parser.add_argument("--json", action="store_true", help="print a JSON object instead of a table")
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Examine, print, and return 4 if something is wrong."""
    from mapweave.doctor.examination import ExaminationOptions, examine
    from mapweave.doctor.finding import first_wrong, report

    take_robot_file(arguments)
    driver = arguments.robot

    def load() -> Settings:
        from mapweave.settings import load_settings

        settings = load_settings(arguments.settings)
        if driver is None:
            return settings
        return replace(settings, robot=replace(settings.robot, driver=driver))

    buses: list[Bus] = []

    def open_robot(settings: Settings) -> Callable[[], Robot] | None:
        from mapweave.agent.drivers.settings import REMOTE

        chosen = settings.robot.driver
        if chosen == REMOTE and driver is None and arguments.settings is None:
            return None
        return lambda: _robot(arguments, settings, chosen, buses)

    people = sys.stdin.isatty() and sys.stdout.isatty() and not arguments.json
    options = ExaminationOptions(
        load, lambda settings: network_of(arguments, settings), open_robot, arguments.data, arguments.drive,
        arguments.offline, _ask if people else lambda words: False,
    )  # fmt: skip
    try:
        findings = list(examine(options))
    finally:
        for bus in buses:
            bus.close()
    first = first_wrong(findings)
    if arguments.json:
        print(json.dumps(report(findings)))
    else:
        _print(findings)
        if first is None:
            print("nothing is wrong")
        else:
            print(f"first: {first.subject}: {first.detail}\ndo: {first.advice}")
    return DONE if first is None else NO


def _robot(arguments: argparse.Namespace, settings: Settings, driver: str, buses: list[Bus]) -> Robot:
    """Open the robot; one behind the network has a bus of its own, which is added to `buses`."""
    from mapweave.agent.drivers.registry import find_driver
    from mapweave.agent.drivers.remote import RemoteRobot
    from mapweave.agent.drivers.settings import REMOTE
    from mapweave.commands.network import connect

    if driver != REMOTE:
        return find_driver(driver)(settings.robot)
    if arguments.robot is None:
        settings.robot.check_remote()
    network = network_of(arguments, settings)
    bus, _ = connect(network)
    buses.append(bus)
    return RemoteRobot(bus, network.fleet, arguments.name or "r0", REMOTE_PATIENCE)


REMOTE_PATIENCE = 5.0
"""s that a base behind the network may be silent."""


def _ask(words: str) -> bool:
    try:
        return input(f"{words}. Enter begins, s skips: ").strip().lower() != "s"
    except EOFError:
        return False  # the terminal's end: there is no person


def _print(findings: Sequence[Finding]) -> None:
    """A table on a terminal, paragraphs on a narrow one, and else a line for each, as long as it is."""
    if (console := _terminal()) is None:
        for one in findings:
            advice = f"; do: {one.advice}" if one.advice else ""
            print(f"{one.verdict:<8} {one.subject:<{SUBJECT}} {one.detail}{advice}")
        return
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    for one in findings:
        verdict = Text(one.verdict, STYLES[one.verdict])
        advice = f"do: {one.advice}" if one.advice else ""
        if console.width >= NARROW:
            table.add_row(verdict, one.subject, Text("\n".join(filter(None, (one.detail, advice)))))
            continue
        console.print(Text.assemble(verdict, f" {one.subject}: {one.detail}"))
        if advice:
            console.print(Padding(Text(advice), (0, 0, 0, 2)))
    if table.rows:
        console.print(table)


def _terminal() -> Console | None:
    """The terminal; None where there is none, or rich is not installed."""
    try:
        from mapweave.terminal import plain_or_terminal

        console = plain_or_terminal(stderr=False)
    except ImportError:
        return None
    return console if console.is_terminal else None
