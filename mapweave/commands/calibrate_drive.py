"""`mapweave calibrate drive`: where the camera stands, and how wheels and clock are scaled, from a drive."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.agent import (
    add_calibration,
    bus_of,
    calibration_of,
    close_on,
    open_robot,
    take_robot_file,
)
from mapweave.commands.network import add_network, network_of, settings_of, stop_on_signals
from mapweave.commands.replay import add_recording, name_of, options_of
from mapweave.commands.value_completion import complete_drivers
from mapweave.exit_status import INTERRUPTED, NO

if TYPE_CHECKING:
    import threading

    from mapweave.agent.calibration.estimate import Estimate
    from mapweave.agent.calibration.recorded_drive import DriveCalibration
    from mapweave.agent.observation import Observation, RobotDescription
    from mapweave.agent.sensor_health.odometry_convention import OdometryConvention


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "drive",
        help="mount, wheels and delay, from half a minute of driving",
        description="Estimate the wheels' scales, the camera's mount and the delay between camera and wheels "
        "from a drive, each with its standard deviation and whether the drive shows it, and keep them under "
        "the robot's name for `mapweave agent` and `mapweave replay`. Drive for half a minute, with turns to "
        "both sides. The drive is a recording, or with --name and --robot or --settings what a robot senses "
        "now; it gets no commands.",
    )
    add_recording(parser, optional=True)
    robot = parser.add_argument(
        "--robot", metavar="NAME|DRIVER|FILE",
        help="of a recording: one of the robots in its splits.toml; without one: as for `agent` "
        "(default: [robot] driver of the settings)",
    )  # fmt: skip
    complete_drivers(robot)
    parser.add_argument(
        "--name", type=values.name, help="the robot's name in the fleet (default: as `replay` names it)"
    )
    parser.add_argument(
        "--seconds",
        type=values.seconds,
        default=40.0,
        metavar="S",
        help="how long to watch a robot (default: 40)",
    )
    parser.add_argument(
        "--keep-wheels", action="store_true",
        help="the declared wheel scale is right: estimate the camera's height (default: the other way round)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    add_calibration(parser)
    add_network(parser)
    parser.set_defaults(run=run, body=None)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, print, write."""
    import os

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import cv2

    from mapweave.agent.calibration.recorded_drive import calibrate
    from mapweave.agent.recordings.geometry_file import KEYS, beyond_limits, write_geometry
    from mapweave.agent.sensor_health.odometry_convention import OdometryConvention
    from mapweave.commands.usage import UsageError
    from mapweave.hybridmap.errors import DeviceError, InvalidValue
    from mapweave.processes.agent import measured
    from mapweave.terminal import plain_or_terminal

    if arguments.recording is None:
        take_robot_file(arguments)
    if arguments.recording is None and not (arguments.name and (arguments.robot or arguments.settings)):
        raise UsageError("give a recording, or --name NAME of a robot and --robot DRIVER or --settings FILE")
    cv2.setNumThreads(1)
    name = name_of(arguments)
    file = calibration_of(arguments, name)
    console = plain_or_terminal(stderr=arguments.json)
    stop = None if arguments.recording is not None else stop_on_signals()
    try:
        description, observations = (
            _recorded(arguments, name, console) if stop is None else _live(arguments, name, console, stop)
        )
        convention = OdometryConvention(description.camera)
        watched = _watched(observations, convention)
        found = calibrate(measured(description, file), watched, arguments.keep_wheels)
    except (InvalidValue, DeviceError) as error:
        # A drive that was cut short is no answer, and neither is a robot that was closed before its first.
        interrupted = stop is not None and stop.is_set()
        if isinstance(error, DeviceError) and not interrupted:
            raise
        print(f"mapweave: {arguments.recording or name}: {error}", file=sys.stderr)
        return INTERRUPTED if interrupted else NO
    notes = _print(console, found)
    usable = found.estimate.usable
    reasons = convention.complaints
    if wrong := beyond_limits({field: getattr(usable, field) for field in KEYS}):
        reasons.append(wrong)
    if found.estimated_px > found.declared_px:
        reasons.append("The declared geometry predicts the pairs held out better")
    for reason in reasons:
        colon = "" if reason.endswith("?") else ":"
        console.print(f"{reason}{colon} nothing is written.", soft_wrap=True, markup=False)
    if not reasons:
        write_geometry(file, usable, notes)
        console.print(f"Written to {file}: `mapweave agent {name}` and `mapweave replay` use it.")
    if arguments.json:
        print(json.dumps(_figures(found, written=not reasons)))
    return NO if reasons else 0


def _watched(observations: Iterable[Observation], convention: OdometryConvention) -> Iterator[Observation]:
    """The same, which the convention sees too."""
    for observation in observations:
        convention.see(observation)
        yield observation


def _recorded(
    arguments: argparse.Namespace, name: str, console: Any
) -> tuple[RobotDescription, Iterator[Observation]]:
    """A recording."""
    from mapweave.agent.drivers.replay import Replay
    from mapweave.terminal import plain_or_terminal, tracked

    robot = Replay(arguments.recording, arguments.robot, options=options_of(arguments))
    for line in (*robot.recording.notes, *robot.recording.damage):
        console.print(line, soft_wrap=True, markup=False)
    observed = iter(robot.sense, None)
    return robot.describe(), tracked(observed, name, len(robot), plain_or_terminal())


def _live(
    arguments: argparse.Namespace, name: str, console: Any, stop: threading.Event
) -> tuple[RobotDescription, Iterator[Observation]]:
    """What a robot senses from now on, for some seconds, or until it is stopped.

    The iterator raises DeviceError when a sensor fails: a base that does not answer would count as one that
    stands.
    """
    import threading

    from mapweave.agent.sensor_health.sensor_monitor import SensorMonitor
    from mapweave.hybridmap.errors import DeviceError
    from mapweave.terminal import Bar

    settings = settings_of(arguments)
    network = network_of(arguments, settings)
    bus = bus_of(arguments, settings.robot, network)
    robot, _ = open_robot(arguments, settings.robot, bus, network.fleet, name)
    threading.Thread(target=close_on, args=(stop, robot), name="stop", daemon=True).start()

    def observations(sensors: SensorMonitor) -> Iterator[Observation]:
        began = 0
        try:
            with Bar(console, f"{name}: drive it, with turns to both sides (s)", arguments.seconds) as bar:
                while (observation := robot.sense()) is not None and not stop.is_set():
                    sensors.see(observation, None)
                    if sensors.fault is not None:
                        raise DeviceError(f"{name}: {sensors.fault.words}; nothing is written")
                    began = began or observation.stamp_ns
                    passed = 1e-9 * (observation.stamp_ns - began)
                    bar.update(round(passed))
                    yield observation
                    if passed >= arguments.seconds:
                        break
        finally:
            robot.close()
            bus.close()

    try:
        description = robot.describe()
    except BaseException:
        robot.close()
        bus.close()
        raise
    return description, observations(SensorMonitor(description))


NUMBER = 6
"""Characters of an estimate, also on a narrow terminal: -0.018."""


def _print(console: Any, found: DriveCalibration) -> dict[str, str]:
    """Print a table of an estimate and what it finds wrong; returns a comment by field."""
    from rich.table import Table

    from mapweave.agent.calibration.report import NAMES, causes, readable, readable_sigmas
    from mapweave.agent.drive_geometry import Parameter

    estimate, notes = found.estimate, {}
    declared, value, sigma = readable(estimate.declared), readable(estimate.vector), readable_sigmas(estimate)
    table = Table("parameter")
    for heading in ("declared", "estimated", "sigma"):
        table.add_column(heading, min_width=NUMBER)
    table.add_column("shown by this drive", overflow="fold")
    for p in Parameter:
        shown = bool(estimate.shown[p])
        table.add_row(
            NAMES[p], f"{declared[p]:.3f}", f"{value[p]:.3f}", f"{sigma[p]:.3f}", "yes" if shown else "no"
        )
        notes[p.name.lower()] = f"sigma {sigma[p]:.2g}" if shown else "as declared, not shown by the drive"
    console.print(table)
    console.print(
        f"{estimate.pairs} image pairs, {estimate.floor_tracks} points on the floor. Points in pairs "
        f"that were held out are {found.declared_px:.2f} px off as declared, "
        f"{found.estimated_px:.2f} px as estimated.",
        soft_wrap=True,
    )
    for cause in causes(estimate):
        console.print(str(cause).removesuffix("; run `mapweave calibrate drive`"), soft_wrap=True)
    return notes


def _figures(found: DriveCalibration, written: bool) -> dict[str, object]:
    from mapweave.agent.calibration.report import readable, readable_sigmas
    from mapweave.agent.drive_geometry import Parameter

    estimate: Estimate = found.estimate
    columns = {
        "declared": readable(estimate.declared).tolist(), "estimated": readable(estimate.vector).tolist(),
        "sigma": readable_sigmas(estimate).tolist(), "shown": estimate.shown.tolist(),
    }  # fmt: skip
    return {
        "parameters": {p.name.lower(): {key: columns[key][p] for key in columns} for p in Parameter},
        "declared_px": found.declared_px,
        "estimated_px": found.estimated_px,
        "written": written,
    }
