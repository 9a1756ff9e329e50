"""Checks the output of a driver; each mistake is an error of one line at the first observation."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from mapweave.agent.drivers.robot import Robot
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.hybridmap.errors import DeviceError

SMALLEST_SHARE = 0.01
"""Stamps that rise by less than this share of a tick are not in nanoseconds."""
FIRST = 10
"""Stamps that must rise as they should. A clock that fails later is no mistake in the driver: the pipeline
stands then, and says so (`sensor_health/clock_monitor.py`)."""
SKEW = 60.0
"""A first stamp this near to the time in another unit is in that unit, s. Others show it by how they rise."""
UNITS = {"seconds": 1.0, "milliseconds": 1e3, "microseconds": 1e6}


class CheckedRobot:
    """Wraps a robot and compares each observation with its description."""

    def __init__(self, robot: Robot, clock: Callable[[], float] = time.time) -> None:
        """Wrap a robot.

        Args:
            robot: the robot.
            clock: seconds since 1970.
        """
        self._robot = robot
        self._clock = clock
        self._description: RobotDescription | None = None
        self._stamp_ns: int | None = None
        self._good = 0

    def describe(self) -> RobotDescription:
        """Description of the robot.

        Raises:
            DeviceError: it is no description, or its bearings are not in radians.
        """
        if self._description is None:
            description = self._robot.describe()
            if not isinstance(description, RobotDescription):
                raise _mistake("describe()", f"must return a RobotDescription, not {_kind(description)}")
            far = [b for b in description.ranger_bearings if not abs(b) <= math.tau]
            if far:
                raise _mistake("describe()", f"ranger_bearings are radians, not degrees: {far[0]:g}")
            if description.ranger_bearings and not description.ranger_reach > 0.0:
                raise _mistake("describe()", "there are ranger_bearings and no ranger_reach, m")
            self._description = description
        return self._description

    def sense(self) -> Observation | None:
        """The next observation.

        Raises:
            DeviceError: the observation is wrong.
        """
        description = self.describe()
        seen = self._robot.sense()
        if seen is None:
            return None
        if not isinstance(seen, Observation):
            raise _mistake("sense()", f"must return an Observation or None, not {_kind(seen)}")
        self._check_stamp(seen.stamp_ns, description.tick)
        _check_image(seen, description)
        _check_numbers(seen, description)
        return seen

    def act(self, command: Command) -> Command:
        """Send a command.

        Raises:
            DeviceError: the driver returns no command.
        """
        applied = self._robot.act(command)
        if not isinstance(applied, Command):
            raise _mistake("act()", f"must return the Command that is applied, not {_kind(applied)}")
        if not (math.isfinite(applied.forward) and math.isfinite(applied.turn)):
            raise _mistake("act()", f"{applied} is not finite")
        return applied

    def close(self) -> None:
        """Stop the wheels and release the robot."""
        self._robot.close()

    def _check_unit(self, stamp_ns: int) -> None:
        """Of the first stamp alone: a clock since the start comes by such numbers later."""
        now = self._clock()
        for unit, in_a_second in UNITS.items():
            if abs(stamp_ns / in_a_second - now) < SKEW:
                raise _mistake("stamp_ns", f"{stamp_ns} are {unit} since 1970; it must be nanoseconds")

    def _check_stamp(self, stamp_ns: int, tick: float) -> None:
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer):
            raise _mistake(
                "stamp_ns", f"{stamp_ns!r} is {_kind(stamp_ns)}; it must be whole nanoseconds, an int"
            )
        if before is None:
            self._check_unit(stamp_ns)
        if before is None or self._good >= FIRST:
            return
        self._good += 1
        if stamp_ns == before:
            raise _mistake("stamp_ns", f"stands still at {stamp_ns}; it is the time of each image")
        if stamp_ns < before:
            raise _mistake("stamp_ns", f"goes backwards, from {before} to {stamp_ns}")
        if stamp_ns - before < SMALLEST_SHARE * tick * 1e9:
            raise _mistake(
                "stamp_ns", f"rises by {stamp_ns - before} in a tick of {tick:g} s; it must be nanoseconds"
            )


def _check_image(seen: Observation, description: RobotDescription) -> None:
    image, camera = seen.image, description.camera
    if image is None:
        return
    if not isinstance(image, np.ndarray):
        raise _mistake("image", f"must be an array, not {_kind(image)}")
    if image.ndim == 3:
        raise _mistake("image", f"has {image.shape[2]} channels; it must be grey, (H, W)")
    if image.ndim != 2 or image.dtype != np.uint8:
        raise _mistake("image", f"must be (H, W) uint8, not {image.shape} {image.dtype}")
    if image.shape != (camera.height, camera.width):
        height, width = image.shape
        raise _mistake(
            "image", f"is {width}x{height} px, but the camera is described as {camera.width}x{camera.height}"
        )


def _check_numbers(seen: Observation, description: RobotDescription) -> None:
    forward, turn = seen.odometry.forward, seen.odometry.turn
    if not (math.isfinite(forward) and math.isfinite(turn)):
        raise _mistake("odometry", f"is not finite: {forward:g} m, {turn:g} rad")
    # An empty array means that the sensors have failed, which the agent handles.
    readings, bearings = np.ndim(seen.proximity), len(description.ranger_bearings)
    if readings != 1:
        raise _mistake("proximity", "must be an array of one distance for each bearing, m")
    count = len(seen.proximity)
    if count and count != bearings:
        raise _mistake("proximity", f"has {count} readings, but describe() gives {bearings} ranger_bearings")


def _kind(value: object) -> str:
    return "None" if value is None else type(value).__name__


def _mistake(what: str, words: str) -> DeviceError:
    return DeviceError(f"driver: {what} {words}")
