"""`mapweave replay`: an agent on a recording."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.agent import add_calibration, add_logs, calibration_of
from mapweave.commands.answer import add_json, print_note
from mapweave.commands.network import (
    add_network,
    client_settings,
    connect,
    network_of,
    settings_of,
    stop_on_signals,
    warn_without_router,
)
from mapweave.exit_status import INTERRUPTED
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import DeviceError

if TYPE_CHECKING:
    from mapweave.agent.recordings.options import RecordingOptions
    from mapweave.agent.recordings.recording import Recording
    from mapweave.hybridmap.ids import MapId
    from mapweave.settings import NetworkSettings
    from mapweave.wire.keys import Keys
    from mapweave.wire.memory import MemoryBus
    from mapweave.wire.zenoh_bus import ZenohBus


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "replay",
        help="run an agent on a recording",
        description="Run a robot's pipeline on recorded camera images and odometry, as if it were carried "
        "along. The map goes to a file and, if a server can be reached, to the server. Of a recording "
        "that is damaged, what can be read is mapped; a line says what is lost, the status is 1.",
    )
    add_recording(parser)
    parser.add_argument("--robot", metavar="NAME", help="one of the robots in the recording's splits.toml")
    parser.add_argument(
        "--name", type=values.name, help="in the fleet (default: the robot's, else the folder's)"
    )
    parser.add_argument(
        "--data", type=Path, default=Path("out/replay"), help="folder for the map (default: out/replay)"
    )
    parser.add_argument("--epoch", type=int, help="least number of the new map (default: the next one)")
    parser.add_argument("--offline", action="store_true", help="do not connect to a router or a server")
    parser.add_argument(
        "--timeout",
        type=values.seconds,
        default=20.0,
        metavar="S",
        help="longest wait for the server (default: 20)",
    )
    add_calibration(parser)
    add_logs(parser)
    add_json(parser)
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
    parser.add_argument(
        "--image-topic",
        metavar="TOPIC",
        help="of a bag (default: that of the settings, else the one with most images)",
    )
    parser.add_argument(
        "--odometry-topic",
        metavar="TOPIC",
        help="of a bag (default: that of the settings, else by its type and name)",
    )
    parser.add_argument(
        "--camera-info-topic",
        metavar="TOPIC",
        help="of a bag (default: that of the settings, else the one beside the images)",
    )


def options_of(arguments: argparse.Namespace) -> RecordingOptions:
    """What a person said of a recording."""
    from mapweave.agent.recordings.options import RecordingOptions

    a = arguments
    return RecordingOptions(
        a.camera, a.camera_height, a.odometry, a.image_topic, a.odometry_topic, a.camera_info_topic,
        settings_of(a).recording,
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Play the recording to its end."""
    from mapweave.agent.drivers.replay import Replay
    from mapweave.agent.recordings.incomplete import NoOdometry
    from mapweave.doctor.camera_model import recorded_faults
    from mapweave.hybridmap.ids import MapId
    from mapweave.processes.agent_files import epochs_of_files

    try:
        robot = Replay(arguments.recording, arguments.robot, options=options_of(arguments))
    except NoOdometry as missing:
        return _map_images(arguments, missing.recording)
    for note in (*robot.recording.notes, *recorded_faults(robot.recording)):
        print_note(arguments, note)  # into a pipe as well before what the agent says, on stderr
    name = name_of(arguments)
    settings, calibration = settings_of(arguments), calibration_of(arguments, name)
    network = network_of(arguments, settings)
    before = epochs_of_files(arguments.data, name)
    bus, keys = _bus(network, name, arguments.offline)
    try:
        # The whole pipeline, while the router is looked for.
        from mapweave.hybridmap.mission_order import MissionKind
        from mapweave.processes.agent import AgentOptions
        from mapweave.processes.agent_process import run_agent

        options = AgentOptions(
            name=name,
            data=arguments.data,
            epoch=arguments.epoch,
            fresh=True,  # a recording begins where it began, not where another has ended
            mission=MissionKind.CARRIED,
            server=network.server,
            total=len(robot),
            recorded=True,
            patience=0.0 if arguments.offline else arguments.timeout,
            calibration=calibration,
            rerun=arguments.rerun,
            mcap_log=arguments.mcap_log,
        )
        stop = stop_on_signals()
        run_agent(robot, bus, keys, settings.agent, options, stop)
    finally:
        bus.close()
    maps = [MapId(name, epoch) for epoch in epochs_of_files(arguments.data, name) if epoch not in before]
    status = _report(arguments, name, (robot.played, len(robot)), maps, robot.damage)
    if stop.is_set() and robot.played < len(robot):
        words = f"interrupted after {robot.played} of {len(robot)} images; what is mapped of them is kept"
        print(f"mapweave: {words}", file=sys.stderr)
        return INTERRUPTED
    return status


def _map_images(arguments: argparse.Namespace, recording: Recording) -> int:
    """Map a recording without odometry by its images alone."""
    from mapweave.agent.replication.epochs import newest_on_server
    from mapweave.agent.replication.journal import Journal
    from mapweave.commands.usage import UsageError
    from mapweave.hybridmap.change import NodePut
    from mapweave.photographs import send_map
    from mapweave.processes.agent import FIRST_PATIENCE
    from mapweave.processes.agent_files import epochs_of_files, map_path, trajectory_path
    from mapweave.storage.map_file import MapFile, write_map_file
    from mapweave.terminal import EventLog, plain_or_terminal, tracked, working
    from mapweave.visual_mapping import keyframes, nothing_mapped, visual_maps
    from mapweave.visual_trajectory import tum_lines

    for option, value in (("--rerun", arguments.rerun), ("--mcap-log", arguments.mcap_log)):
        if value is not None:
            raise UsageError(
                f"{recording.path}: has no odometry, so no agent runs on it that {option} could show: "
                "leave it out"
            )
    taken_images = images_of(recording, arguments.robot)
    name, data, console = name_of(arguments), arguments.data, plain_or_terminal()
    say = EventLog(console)
    network = network_of(arguments, settings_of(arguments))
    first = f"{recording.path}: no odometry, so it is mapped by its images alone: the map has no scale"
    for note in (first, *recording.notes):
        print_note(arguments, note)
    data.mkdir(parents=True, exist_ok=True)
    path = data / f"{name}.sqlite"
    journal = Journal(path, name)
    taken = [*epochs_of_files(data, name), *(known_map.epoch for known_map in journal.maps())]
    journal.close()
    bus, keys = _bus(network, name, arguments.offline)
    try:
        stored = None
        if not (taken or arguments.epoch or arguments.offline):
            stored = newest_on_server(bus, keys, network.server, name, FIRST_PATIENCE)
        epoch = max(arguments.epoch or 0, *(used + 1 for used in taken), (stored or 0) + 1)
        frames = tracked(taken_images, name, console=console)
        walk, damage = keyframes(recording, frames)
        with working("finding where the images were taken"):
            maps = visual_maps(walk, recording.camera, name, epoch)
        if not maps:
            raise DeviceError(nothing_mapped(recording.path, walk, damage))
        for one in maps:
            file = map_path(data, one.id)
            write_map_file(file, MapFile("agent", str(one.id), tuple(one.changes)))
            trajectory_path(data, one.id).write_text(tum_lines(one.trajectory))
            nodes = sum(isinstance(change, NodePut) for change in one.changes)
            say(f"{name}: {counted(nodes, 'node')} in {file}; its scale is unknown")
            if not arguments.offline:
                sent = send_map(one.changes, one.id, path, bus, keys, network.server, arguments.timeout)
                say(f"{name}: server {network.server} has {'' if sent else 'not taken '}it all")
        poses = [pose for one in maps for pose in one.trajectory]
        found = sum(pose.found for pose in poses)
        say(
            f"{name}: of {counted(len(taken_images), 'image')} {found} are found in a map, "
            f"{len(poses) - found} interpolated, {len(taken_images) - len(poses)} in none"
        )
    finally:
        bus.close()
    images = (len(taken_images),) * 2
    return _report(arguments, name, images, [one.id for one in maps], [*recording.damage, *damage])


def images_of(recording: Recording, robot: str | None) -> range:
    """Numbers of the images of one robot of the splits.toml beside a recording; all without a robot.

    Raises:
        DeviceError: the file is missing or wrong, or has no such robot.
    """
    from mapweave.agent.recordings.splits import read_split

    folder = recording.path if recording.path.is_dir() else recording.path.parent
    return read_split(folder / "splits.toml", robot, len(recording))


def _bus(network: NetworkSettings, name: str, offline: bool) -> tuple[ZenohBus | MemoryBus, Keys]:
    """The connection; offline it reaches no one."""
    from mapweave.wire.keys import Keys
    from mapweave.wire.memory import MemoryBus, MemoryHub

    if offline:
        return MemoryBus(MemoryHub()), Keys(network.fleet)
    bus, keys = connect(network)
    warn_without_router(bus, name, client_settings(network))
    return bus, keys


def name_of(arguments: argparse.Namespace) -> str:
    """The robot's name in the fleet: as given, else that of its splits.toml, else the file's or folder's."""
    import re

    from mapweave.hybridmap.ids import check_name

    if arguments.name:
        return check_name(arguments.name)
    given = (arguments.robot or arguments.recording.resolve().stem).lower()
    fallback = re.sub("[^a-z0-9_-]", "-", given).strip("-_")[:32]  # a longer name is refused
    return check_name(fallback or "recording")


def _report(
    arguments: argparse.Namespace, name: str, images: tuple[int, int], maps: Sequence[MapId],
    damage: Sequence[str],
) -> int:  # fmt: skip
    """Say what could not be read, and with `--json` what came of it; the exit status.

    Args:
        arguments: of the command line.
        name: of the robot.
        images: how many were played, and of how many.
        maps: that were made.
        damage: a line each.
    """
    from mapweave.json_log import one_line
    from mapweave.processes.agent_files import map_path

    for line in damage:
        print(f"mapweave: {one_line(line)}", file=sys.stderr)
    if arguments.json:
        files = [{"map": str(one), "path": str(map_path(arguments.data, one))} for one in maps]
        played = {"images": images[1], "played": images[0], "maps": files, "damage": list(damage)}
        print(json.dumps({"robot": name, **played}))
    return 1 if damage else 0
