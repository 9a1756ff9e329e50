"""`mapweave sim`: robots in a simulated office."""

from __future__ import annotations

import argparse
from typing import Any

from mapweave.commands.network import add_network, connect, network_of, settings_of, stop_on_signals


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "sim",
        help="simulate robots in an office",
        description="Simulate differential-drive robots with cameras in a PyBullet office, in lock-step: "
        "time advances when every agent has sent its command. Robots are called r0, r1 ...",
    )
    parser.add_argument("--robots", type=int, default=3, help="how many (default: 3)")
    parser.add_argument("--rooms", type=int, default=3, help="rooms along the corridor (default: 3)")
    parser.add_argument("--seed", type=int, default=0, help="of textures, furniture, start places and faults")
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Serve the simulated bodies until told to stop."""
    settings = settings_of(arguments)
    network = network_of(arguments, settings)

    from mapweave.sim_process import run_sim

    stop = stop_on_signals()
    bus, _ = connect(network)
    try:
        run_sim(bus, network.fleet, arguments.robots, arguments.rooms, arguments.seed, stop)
    finally:
        bus.close()
    return 0
