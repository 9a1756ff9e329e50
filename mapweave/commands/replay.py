"""`mapweave replay`: an agent on a recording."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands.agent import add_calibration, calibration_of
from mapweave.commands.network import add_network, connect, network_of, settings_of, stop_on_signals

if TYPE_CHECKING:
    from mapweave.agent.recordings.options import RecordingOptions


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "replay",
        help="run an agent on a recording",
        description="Run a robot's pipeline on recorded camera images and odometry, as if it were carried "
        "along. The map goes to a file and, if a server can be reached, to the server.",
    )
    add_recording(parser)
    parser.add_argument("--robot", metavar="NAME", help="one of the robots in the recording's splits.toml")
    parser.add_argument("--name", help="in the fleet (default: the robot's, else the folder's)")
    parser.add_argument("--data", type=Path, default=Path("out/replay"), help="folder for the map")
    parser.add_argument("--epoch", type=int, help="least number of the new map (default: the next one)")
    parser.add_argument("--offline", action="store_true", help="do not connect to a server")
    parser.add_argument(
        "--patience", type=float, default=20.0, metavar="S", help="longest wait for the server"
    )
    add_calibration(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def add_recording(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    """Declare a recording, and what a person may have to say of it."""
    parser.add_argument(
        "recording", type=Path, nargs="?" if optional else None,
        help="folder with images/, camera.toml and odometry.csv; ROS bag (.mcap, .bag, .db3, folder); video; "
        "sequence of KITTI odometry, EuRoC, TUM RGB-D or 4Seasons",
    )  # fmt: skip
    parser.add_argument("--camera", type=Path, metavar="FILE", help="camera.toml, if it has none")
    parser.add_argument(
        "--camera-height", type=float, metavar="M", help="above the floor, if it does not say"
    )
    parser.add_argument(
        "--odometry", type=Path, metavar="FILE",
        help="stamped poses: CSV with stamp_s, x_m, y_m, heading_rad, or lines as TUM and evo write them",
    )  # fmt: skip
    parser.add_argument("--image-topic", metavar="TOPIC", help="of a bag (default: the one with most images)")
    parser.add_argument("--odometry-topic", metavar="TOPIC", help="of a bag (default: by its type and name)")


def name_of(arguments: argparse.Namespace) -> str:
    """The name of a recording's robot: that of its splits.toml, else the file's or folder's."""
    name: str = arguments.robot or arguments.recording.resolve().stem
    return re.sub("[^a-z0-9_-]", "-", name.lower())


def options_of(arguments: argparse.Namespace) -> RecordingOptions:
    """What a person said of a recording."""
    from mapweave.agent.recordings.options import RecordingOptions

    a = arguments
    return RecordingOptions(a.camera, a.camera_height, a.odometry, a.image_topic, a.odometry_topic)


def run(arguments: argparse.Namespace) -> int:
    """Play the recording to its end."""
    from mapweave.agent.drivers.replay import Replay
    from mapweave.agent.mission import Carried
    from mapweave.hybridmap.node import check_name
    from mapweave.processes.agent import AgentOptions, run_agent

    robot = Replay(arguments.recording, arguments.robot, options=options_of(arguments))
    for note in robot.recording.notes:
        print(note)
    name = check_name(arguments.name or name_of(arguments))
    settings = settings_of(arguments)
    network = network_of(arguments, settings)
    options = AgentOptions(
        name=name,
        data=arguments.data,
        epoch=arguments.epoch,
        fresh=True,  # a recording begins where it began, not where another has ended
        mission=Carried(),
        server=network.server,
        total=len(robot),
        trajectories=True,
        patience=0.0 if arguments.offline else arguments.patience,
        calibration=calibration_of(arguments, name),
    )
    stop = stop_on_signals()
    bus, keys = connect(network)
    try:
        run_agent(robot, bus, keys, settings.agent, options, stop)
    finally:
        bus.close()
    return 0
