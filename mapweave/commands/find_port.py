"""`mapweave find-port`: which serial port a robot is at."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

from mapweave.commands import values

POLL = 0.2
"""s between two looks."""


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "find-port",
        help="find the serial port of a robot",
        description="Find the serial port of a robot: unplug its cable, and the port is named. Without a "
        "terminal, or with --list, the ports are listed. Exit status 4 if there is none.",
    )
    parser.add_argument("--list", action="store_true", help="list the ports, and wait for nothing")
    parser.add_argument(
        "--timeout", type=values.seconds, default=60.0, metavar="S", help="for the cable (default: 60)"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """List the ports, then wait until one is gone."""
    from mapweave.doctor.ports import gone, serial_ports
    from mapweave.hybridmap.errors import Refused

    before = serial_ports()
    if not before:
        raise Refused(
            "there is no serial port, as /dev/ttyUSB0 or /dev/ttyACM0: is the robot connected and switched "
            "on, and its cable one for data?"
        )
    for port in before:
        print(port.line)
    if arguments.list or not sys.stdin.isatty():
        return 0
    print("Unplug the robot's cable now ...", flush=True)
    end = time.monotonic() + arguments.timeout
    while time.monotonic() < end:
        left = gone(before, serial_ports())
        if left:
            for port in left:
                print(f"it was {port.stable or port.path}: plug it in, and give [robot.options] port that")
            return 0
        time.sleep(POLL)
    raise Refused(
        f"no port has gone within {arguments.timeout:g} s; a port on the board itself cannot be unplugged"
    )
