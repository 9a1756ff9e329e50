"""The driver: whether it finds its robot, what it delivers, and whether the encoders are true."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from mapweave.doctor import camera, camera_model
from mapweave.doctor.finding import Finding, good, skipped, warning, wrong
from mapweave.doctor.motion import SUBJECT as ENCODERS
from mapweave.doctor.motion import MotionComparison
from mapweave.doctor.ports import serial_ports

if TYPE_CHECKING:
    from mapweave.agent.drivers.robot import Robot
    from mapweave.agent.observation import Command, Observation, RobotDescription

SECONDS = 2.0
"""Of observations while the robot stands."""
FEWEST_IMAGES = 0.7
"""Share of the observations that should have an image."""
MOTION_SECONDS = 10.0
"""Longest motion."""
PUSH = "Push the robot forward by about 30 cm and turn it by about 45 degrees within 10 s"
DRIVE_SPEED, TURN_RATE = 0.1, 0.4
"""m/s and rad/s, by itself."""
DRIVE_SECONDS, TURN_SECONDS = 2.0, 2.0
"""s: 20 cm and 46 degrees at those speeds."""


def examine(
    open_robot: Callable[[], Robot], has_camera: bool, drives: bool, ask: Callable[[str], bool]
) -> Iterator[Finding]:
    """Open a robot, look at its observations, then at its motion.

    Args:
        open_robot: raises DeviceError or SettingsError.
        has_camera: whether its camera was examined by itself.
        drives: let it drive by itself, 20 cm forward and 45 degrees to the left.
        ask: asks a person to do something, returns whether it will be done; always False without a person.
    """
    from mapweave.agent.drivers.checked import CheckedRobot
    from mapweave.hybridmap.errors import MapweaveError

    robot: Robot | None = None
    try:
        robot = CheckedRobot(open_robot())
        description = robot.describe()
        seen = list(_observe(robot, SECONDS))
    except MapweaveError as error:
        if robot is not None:
            robot.close()
        yield wrong("driver", str(error), _advice(str(error)))
        return
    try:
        yield from _judge(description, seen)
        if not has_camera:
            yield from camera_model.examine(description)
            images = [one.image for one in seen if one.image is not None]
            if images:
                yield camera.image_quality(images)
        yield from _motion(robot, description, drives, ask)
    except MapweaveError as error:
        yield wrong(ENCODERS, str(error), _advice(str(error)))
    finally:
        robot.close()


def _observe(robot: Robot, seconds: float, command: Command | None = None) -> Iterator[Observation]:
    """Observations for a while, of a robot that stands or does what is commanded, as far as it is safe."""
    from mapweave.agent.observation import Command
    from mapweave.agent.servo.proximity import guard

    # By the robot's stamps: a simulated one may be faster. A clock that stands still ends it, too.
    end, first_ns = time.monotonic() + 3.0 * seconds, None
    while time.monotonic() < end:
        observation = robot.sense()
        if observation is None:
            return
        yield observation
        first_ns = observation.stamp_ns if first_ns is None else first_ns
        if observation.stamp_ns - first_ns >= seconds * 1e9:
            break
        safe, _ = guard(command or Command(), observation.proximity, robot.describe())
        robot.act(Command() if observation.bumped else safe)
    robot.act(Command())


def _judge(description: RobotDescription, seen: list[Observation]) -> Iterator[Finding]:
    if not seen:
        yield wrong("driver", "answers, and gives no observation", "start the robot's base")
        return
    rate = (len(seen) - 1) / max((seen[-1].stamp_ns - seen[0].stamp_ns) * 1e-9, 1e-3)
    images = sum(one.image is not None for one in seen)
    promised = len(description.ranger_bearings)
    words = (
        f"{len(seen)} observations, {rate:.0f} a second, {images} with an image, {promised} proximity sensors"
    )
    if not images:
        yield wrong("driver", f"{words}: no image", "connect the camera")
    elif images < FEWEST_IMAGES * len(seen):
        yield warning("driver", words, "the agent takes an image a tick: more light, or a smaller image")
    elif promised and not any(len(one.proximity) for one in seen):
        yield wrong(
            "driver",
            f"{words}, none of them read",
            "check the sensors, or ranger_bearings_deg in [robot.geometry]",
        )
    elif not promised:
        yield warning(
            "driver", words, "without proximity sensors it explores nothing by itself: --mission carried"
        )
    else:
        yield good("driver", words)


def _motion(
    robot: Robot, description: RobotDescription, drives: bool, ask: Callable[[str], bool]
) -> Iterator[Finding]:
    from mapweave.agent.observation import Command
    from mapweave.agent.servo.proximity import guard

    comparison, stopped = MotionComparison(description), ""
    if drives:
        if description.max_forward <= 0.0:
            yield skipped(ENCODERS, "the robot takes no commands")
            return
        for seconds, command in (
            (DRIVE_SECONDS, Command(DRIVE_SPEED, 0.0)),
            (TURN_SECONDS, Command(0.0, TURN_RATE)),
        ):
            for observation in _observe(robot, seconds, command):
                comparison.see(observation)
                stopped = stopped or guard(command, observation.proximity, description).reason
    elif ask(PUSH):
        for observation in _observe(robot, MOTION_SECONDS):
            comparison.see(observation)
            if comparison.moved and comparison.compared > 30:
                break
    else:
        yield skipped(
            ENCODERS,
            "not compared with the image: there is no terminal to ask for a push",
            "mapweave doctor --drive",
        )
        return
    yield from comparison.judge(stopped)


def _advice(error: str) -> str:
    """What to do about an error of a driver, most of which say it themselves."""
    if "waits for the agents" in error:
        return "start the agents of its other robots, or a simulation of this robot alone: --set robots=1"
    if "the default, does not use" in error:
        return "name the driver of the robot in [robot]"
    if "mapweave sim serve" in error:
        return "start it, and the router between (mapweave server), or name another driver (mapweave robots)"
    if "in use" in error:
        return "stop the program that uses it, for example a running agent"
    if "may not be opened" in error:
        return "sudo usermod -aG dialout $USER, then log in again"
    if "port" in error or "/dev/" in error or "no answer" in error:
        ports = ", ".join(port.path for port in serial_ports())
        there = f"there are {ports}" if ports else "there is no serial port at all"
        return f"mapweave find-port finds its port; {there}"
    return "see docs/drivers.md"
