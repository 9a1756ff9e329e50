"""Checks the output of a driver; each mistake is an error of one line at the first observation."""

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from numbers import Real

import numpy as np

from mapweave.agent.drivers.author_errors import driver_error, kind_of, mistake
from mapweave.agent.drivers.messages import encode_description
from mapweave.agent.drivers.robot import Robot
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.hybridmap.errors import DeviceError, InvalidValue, MapweaveError
from mapweave.vision.image_reduction import ImageSize, reduced_image, reduced_optics, reduced_size

log = logging.getLogger(__name__)

SMALLEST_SHARE = 0.01
"""Stamps that rise by less than this share of a tick are not in nanoseconds."""
FIRST = 10
"""Stamps that must rise as they should. A clock that fails later is no mistake in the driver: the pipeline
stands then, and says so (`sensor_health/clock_monitor.py`)."""
SKEW = 60.0
"""A first stamp this near to the time in another unit is in that unit, s. Others show it by how they rise."""
UNITS = {"seconds": 1.0, "milliseconds": 1e3, "microseconds": 1e6}
LARGEST = 1e4
"""m or rad; a larger motion in a tick is no measurement, and covariances overflow."""
TOO_FAST = 10.0
"""So many times as fast as it is described to be, no robot moves: the unit is wrong, or the motion is not the
one since the observation before. Only the first motions are judged, as the first stamps are: encoders that
jump later have failed, which the pipeline says (`sensor_health/encoder_monitor.py`)."""
TOO_FAR = 10.0
"""So many times as far as it is said to reach, no sensor reads: it is in centimetres or millimetres."""
SLACK = (0.5, 1.0)
"""m and rad in a tick that are never too much: of a robot that is pushed, or whose observation comes late."""


class CheckedRobot:
    """Wraps a robot and compares each observation with its description.

    Images that are larger than agents work on are reduced, and the camera with them, as those of recordings.
    """

    def __init__(self, robot: Robot, clock: Callable[[], float] = time.time) -> None:
        """Wrap a robot.

        Args:
            robot: the robot.
            clock: seconds since 1970.
        """
        self._robot = robot
        self._clock = clock
        self._given: RobotDescription | None = None
        self._description: RobotDescription | None = None
        self._stamp_ns: int | None = None
        self._good = self._moved = 0
        self._waiting_since: float | None = None
        self._closed = False

    def describe(self) -> RobotDescription:
        """Description of the robot; its camera is that of the images that `sense` returns.

        Raises:
            DeviceError: it is no description, or a value of it is wrong, or the driver has failed.
        """
        if self._description is None:
            with _driver_code():
                description = self._robot.describe()
            _check_description(description)
            self._given, self._description = description, _reduced(description)
        return self._description

    @property
    def waiting(self) -> float:
        """How long the driver's `sense` has not returned, s; 0 outside of it."""
        since = self._waiting_since
        return 0.0 if since is None else time.monotonic() - since

    def sense(self) -> Observation | None:
        """The next observation.

        Raises:
            DeviceError: the observation is wrong, or the driver has failed.
        """
        description = self.describe()
        self._waiting_since = time.monotonic()
        seen = None
        try:
            with _driver_code(), self._until_closed():
                seen = self._robot.sense()
        finally:
            self._waiting_since = None
        if seen is None:
            if not self._closed:
                log.info("no more observations (the driver's sense() has returned None): the agent ends")
            return None
        if not isinstance(seen, Observation):
            raise mistake("sense()", f"must return an Observation or None, not {kind_of(seen)}")
        before_ns = self._stamp_ns
        self._check_stamp(seen.stamp_ns, description.tick)
        assert self._given is not None
        _check_image(seen, self._given)
        _check_numbers(seen, description)
        if before_ns is None:
            _check_unit_of_proximity(seen, description.ranger_reach)
        else:
            self._check_motion(seen.odometry, max((seen.stamp_ns - before_ns) * 1e-9, description.tick))
        if seen.image is None or description is self._given:
            return seen
        size = ImageSize(description.camera.width, description.camera.height)
        return replace(seen, image=reduced_image(seen.image, size))

    def act(self, command: Command) -> Command:
        """Send a command.

        Raises:
            DeviceError: the driver returns no command, or has failed.
        """
        applied = Command()
        with _driver_code(), self._until_closed():
            applied = self._robot.act(command)
        if not isinstance(applied, Command):
            raise mistake("act()", f"must return the Command that is applied, not {kind_of(applied)}")
        if not (math.isfinite(applied.forward) and math.isfinite(applied.turn)):
            raise mistake("act()", f"{applied} is not finite")
        return applied

    def close(self) -> None:
        """Stop the wheels and release the robot. A driver that fails at that is logged: the map is kept."""
        self._closed = True
        try:
            with _driver_code():
                self._robot.close()
        except DeviceError as error:
            log.error("%s", error)

    @contextmanager
    def _until_closed(self) -> Iterator[None]:
        """What a driver's own code raises because it was closed meanwhile is no failure."""
        try:
            yield
        except MapweaveError:
            raise
        except Exception:
            if not self._closed:
                raise

    def _check_unit(self, stamp_ns: int) -> None:
        """Check the unit of the first stamp alone: a clock since the start comes by such numbers later."""
        now = self._clock()
        for unit, in_a_second in UNITS.items():
            if abs(stamp_ns / in_a_second - now) < SKEW:
                raise mistake("stamp_ns", f"{stamp_ns} are {unit} since 1970; it must be nanoseconds")

    def _check_stamp(self, stamp_ns: int, tick: float) -> None:
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer):
            raise mistake(
                "stamp_ns", f"{stamp_ns!r} is {kind_of(stamp_ns)}; it must be whole nanoseconds, an int"
            )
        if before is None:
            self._check_unit(stamp_ns)
        if before is None or self._good >= FIRST:
            return
        self._good += 1
        if stamp_ns == before:
            raise mistake("stamp_ns", f"stands still at {stamp_ns}; it is the time of each image")
        if stamp_ns < before:
            raise mistake("stamp_ns", f"goes backwards, from {before} to {stamp_ns}")
        if stamp_ns - before < SMALLEST_SHARE * tick * 1e9:
            raise mistake(
                "stamp_ns",
                f"rises by {stamp_ns - before} in a tick of {tick:g} s; it must be nanoseconds, and tick of "
                "describe() seconds",
            )

    def _check_motion(self, odometry: Odometry, seconds: float) -> None:
        """Check the first observations in which the robot has moved."""
        if self._moved >= FIRST or not (odometry.forward or odometry.turn):
            return
        self._moved += 1
        limits = self.describe()
        for value, fastest, slack, unit in (
            (odometry.forward, limits.max_forward, SLACK[0], "m"),
            (odometry.turn, limits.max_turn, SLACK[1], "rad"),
        ):
            # A robot that is carried takes no commands, and has no limits.
            if fastest and abs(value) > TOO_FAST * fastest * seconds + slack:
                raise mistake(
                    "odometry",
                    f"is {value:g} {unit} in {seconds:.2g} s, but describe() gives at most {fastest:g} "
                    f"{unit}/s; it must be m and rad since the observation before",
                )


def _reduced(given: RobotDescription) -> RobotDescription:
    """The description for reduced images; itself if its images are not too large for agents."""
    camera = given.camera
    size = reduced_size(camera.width, camera.height)
    if size == (camera.width, camera.height):
        return given
    small, lens = reduced_optics(camera, given.distortion, size)
    log.info("images are reduced from %dx%d to %dx%d px", camera.width, camera.height, *size)
    return replace(given, camera=small, distortion=lens)


@contextmanager
def _driver_code() -> Iterator[None]:
    """Runs code of the driver: what it raises becomes a DeviceError with its file and line."""
    try:
        yield
    except MapweaveError:
        raise
    except Exception as error:
        raise driver_error(error) from error


def _check_description(description: object) -> None:
    if not isinstance(description, RobotDescription):
        raise mistake("describe()", f"must return a RobotDescription, not {kind_of(description)}")
    bearings = description.ranger_bearings
    if not isinstance(bearings, tuple | list):
        raise mistake("describe()", f"ranger_bearings must be a tuple of radians, not {kind_of(bearings)}")
    far = [b for b in bearings if isinstance(b, Real) and not abs(b) <= math.tau]
    if far:
        raise mistake("describe()", f"ranger_bearings are radians, not degrees: {far[0]:g}")
    try:
        encode_description(description)
    except InvalidValue as error:
        raise mistake("describe()", f"gives no {error}") from None
    if bearings and not description.ranger_reach > 0.0:
        raise mistake("describe()", "there are ranger_bearings and no ranger_reach, m")


def _check_image(seen: Observation, description: RobotDescription) -> None:
    image, camera = seen.image, description.camera
    if image is None:
        return
    if not isinstance(image, np.ndarray):
        raise mistake("image", f"must be an array, not {kind_of(image)}")
    if image.ndim == 3:
        raise mistake("image", f"has {image.shape[2]} channels; it must be grey, (H, W)")
    if image.ndim != 2 or image.dtype != np.uint8:
        raise mistake("image", f"must be (H, W) uint8, not {image.shape} {image.dtype}")
    if image.shape != (camera.height, camera.width):
        height, width = image.shape
        raise mistake(
            "image", f"is {width}x{height} px, but the camera is described as {camera.width}x{camera.height}"
        )


def _check_numbers(seen: Observation, description: RobotDescription) -> None:
    if not isinstance(seen.odometry, Odometry):
        raise mistake("odometry", f"must be an Odometry, not {kind_of(seen.odometry)}")
    forward, turn = seen.odometry.forward, seen.odometry.turn
    if not (isinstance(forward, Real) and isinstance(turn, Real)):
        raise mistake("odometry", f"must be two numbers, m and rad, not {forward!r} and {turn!r}")
    if not (math.isfinite(forward) and math.isfinite(turn)):
        raise mistake("odometry", f"is not finite: {forward:g} m, {turn:g} rad")
    if max(abs(forward), abs(turn)) > LARGEST:
        raise mistake("odometry", f"is no motion in a tick: {forward:g} m, {turn:g} rad")
    if not isinstance(seen.proximity, np.ndarray):
        raise mistake("proximity", f"must be an array, not {kind_of(seen.proximity)}")
    # An empty array means that the sensors have failed, which the agent handles.
    if seen.proximity.ndim != 1 or seen.proximity.dtype.kind not in "fiu":
        raise mistake("proximity", "must be an array of one distance for each bearing, m")
    count, bearings = len(seen.proximity), len(description.ranger_bearings)
    if count and count != bearings:
        raise mistake("proximity", f"has {count} readings, but describe() gives {bearings} ranger_bearings")
    for name in ("bumped", "kidnapped"):
        value = getattr(seen, name)
        if not isinstance(value, bool | np.bool_):
            raise mistake(name, f"must be True or False, not {value!r}")
    battery = seen.battery
    if battery is not None and not (isinstance(battery, Real) and 0.0 <= battery <= 1.0):
        raise mistake("battery", f"is {battery!r}; it must be a share from 0 to 1, or None")


def _check_unit_of_proximity(seen: Observation, reach: float) -> None:
    """Check the first readings alone: a sensor that fails later is for the pipeline to say."""
    far = seen.proximity[np.isfinite(seen.proximity) & (seen.proximity > TOO_FAR * reach)]
    if far.size:
        raise mistake(
            "proximity", f"reads {far[0]:g}, but describe() gives ranger_reach {reach:g} m; both are m"
        )
