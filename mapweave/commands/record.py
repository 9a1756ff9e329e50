"""`mapweave record`: what a robot senses, as MCAP."""

import argparse
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

from mapweave.commands import values
from mapweave.commands.agent import (
    add_robot,
    bus_of,
    close_on,
    open_robot,
    print_error,
    take_robot_file,
)
from mapweave.commands.answer import add_json, print_said
from mapweave.commands.network import add_network, network_of, settings_of, stop_on_signals


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "record",
        help="record what a robot senses",
        description="Write a robot's images, odometry and proximity to MCAP files with standard messages, "
        "until it is interrupted. The robot gets no commands: drive it by other means, or let "
        "`mapweave agent --record DIR` drive. `mapweave replay DIR` maps the recording.",
    )
    parser.add_argument("name", type=values.name, help="the robot's name in the fleet, for example r0")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="new or empty folder")
    parser.add_argument("--lossless", action="store_true", help="images as PNG instead of JPEG")
    add_json(parser)
    add_robot(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Record until the robot ends or the process is stopped."""
    from mapweave.agent.drivers.recorded import RecordedRobot
    from mapweave.agent.recordings.mcap_writer import check_new
    from mapweave.terminal import Bar, plain_or_terminal

    name: str = arguments.name
    take_robot_file(arguments)
    settings = settings_of(arguments)
    network = network_of(arguments, settings)
    check_new(arguments.out)
    stop = stop_on_signals()
    if arguments.body:
        network = replace(network, endpoints=(arguments.body,))
    bus = bus_of(arguments, settings.robot, network)
    try:
        robot, _ = open_robot(arguments, settings.robot, bus, network.fleet, name, stop=stop)
        threading.Thread(target=close_on, args=(stop, robot), name="stop", daemon=True).start()
        recorded = RecordedRobot(robot, arguments.out, arguments.lossless, print_error)
        try:
            print_error(f"{name}: waits for its robot")
            recorded.describe()
            with Bar(plain_or_terminal(), f"{name}: observations in {arguments.out}", None) as bar:
                while not (stop.is_set() or recorded.failed) and recorded.sense() is not None:
                    bar.update(recorded.written)
        finally:
            recorded.close()
    finally:
        bus.close()
    # What came in the last seconds before a disk was full is there in part.
    most = "at most " if recorded.failed else ""
    print_said(
        arguments,
        f"{name}: {most}{recorded.written} observations in {arguments.out}",
        robot=name,
        folder=str(arguments.out),
        observations=recorded.written,
        whole=not recorded.failed,
    )
    return 1 if recorded.failed else 0
