"""`mapweave replay`: an agent on a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mapweave.commands.network import add_network, connect, network_of, settings_of, stop_on_signals


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "replay",
        help="run an agent on a recording",
        description="Run a robot's pipeline on recorded camera images and odometry, as if it were carried "
        "along. The map goes to a file and, if a server can be reached, to the server.",
    )
    parser.add_argument("folder", type=Path, help="recording: images/, camera.toml, odometry.csv, times.txt")
    parser.add_argument("--robot", metavar="NAME", help="one of the robots in the recording's splits.toml")
    parser.add_argument("--name", help="in the fleet (default: the robot's, else the folder's)")
    parser.add_argument("--data", type=Path, default=Path("out/replay"), help="folder for the map")
    parser.add_argument("--epoch", type=int, help="least number of the new map (default: the next one)")
    parser.add_argument("--offline", action="store_true", help="do not connect to a server")
    parser.add_argument(
        "--patience", type=float, default=20.0, metavar="S", help="longest wait for the server"
    )
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Play the recording to its end."""
    import re

    from mapweave.agent.drivers.replay import Replay
    from mapweave.agent.mission import Carried
    from mapweave.hybridmap.node import check_name
    from mapweave.processes.agent import AgentOptions, run_agent

    robot = Replay(arguments.folder, arguments.robot)
    fallback = re.sub("[^a-z0-9_-]", "-", (arguments.robot or arguments.folder.resolve().name).lower())
    settings = settings_of(arguments)
    network = network_of(arguments, settings)
    options = AgentOptions(
        name=check_name(arguments.name or fallback),
        data=arguments.data,
        epoch=arguments.epoch,
        fresh=True,  # a recording begins where it began, not where another has ended
        mission=Carried(),
        server=network.server,
        total=len(robot),
        patience=0.0 if arguments.offline else arguments.patience,
    )
    stop = stop_on_signals()
    bus, keys = connect(network)
    try:
        run_agent(robot, bus, keys, settings.pipeline, options, stop)
    finally:
        bus.close()
    return 0
