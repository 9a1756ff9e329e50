"""`mapweave find-port`: which serial port a robot is at."""

import argparse
import sys
import time
from dataclasses import asdict
from typing import Any

from mapweave.commands import values
from mapweave.commands.answer import add_json, print_note, print_said

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
    add_json(parser)
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
    ports = list(map(asdict, before))
    lines = [port.line for port in before]
    if arguments.list or not sys.stdin.isatty():
        print_said(arguments, *lines, ports=ports, unplugged=[])
        return 0
    print_note(arguments, "\n".join((*lines, "Unplug the robot's cable now ...")))
    end = time.monotonic() + arguments.timeout
    while time.monotonic() < end:
        left = gone(before, serial_ports())
        if left:
            names = [port.stable or port.path for port in left]
            said = [f"it was {name}: plug it in, and give [robot.options] port that" for name in names]
            print_said(arguments, *said, ports=ports, unplugged=names)
            return 0
        time.sleep(POLL)
    raise Refused(
        f"no port has gone within {arguments.timeout:g} s; a port on the board itself cannot be unplugged"
    )
