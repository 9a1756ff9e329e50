"""A robot made of a base and a camera, with odometry at the time of each image and no blocking calls."""

import logging
import threading
import time
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.drivers.author_errors import (
    DriverMistake,
    check_base,
    check_reading,
    check_wheels,
    driver_error,
    kind_of,
    mistake,
)
from mapweave.agent.drivers.base import Base, BaseReading, Wheels
from mapweave.agent.drivers.camera import Capture, FrameSource, StampedImage
from mapweave.agent.drivers.clock import now_ns
from mapweave.agent.drivers.robot import clip
from mapweave.agent.drivers.settings import Geometry, RobotSettings
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.hybridmap.errors import DeviceError

log = logging.getLogger(__name__)

POLL = 0.05
"""s between two readings of the base; half a tick."""
RETRY = 0.3
"""s between two attempts to open the base."""
PATIENCE = 5.0
"""s that `describe` waits for the first answer of the base."""
STALE = 0.5
"""s; older proximity readings are not reported."""
SILENT = 2.0
"""s without an answer after which a base is called silent whose driver waits on; most give up before that."""
OLDEST_IMAGE_NS = 1_000_000_000
"""Assumed age of the first image on arrival; later the age of the last image is used."""
LONGEST_EXTRAPOLATION_NS = 100_000_000
"""Longest extrapolation of the wheels at constant speed beyond their last reading."""


class WheeledRobot:
    """The Robot protocol over a base and a camera.

    One thread sends the newest command to the base, reads it, and reconnects when the line fails. Another
    thread captures images. `sense` and `act` only exchange values with these threads.

    Attributes:
        initialized: whether the constructor has run to its end; a subclass may forget to call it.
    """

    initialized = False

    def __init__(self, base: Base, settings: RobotSettings, camera: FrameSource | None = None) -> None:
        """Open the camera and start to connect.

        Args:
            base: wheels and sensors.
            settings: camera and geometry.
            camera: replaces the camera of the settings.

        Raises:
            SettingsError: there is no camera.
            StreamAway: the camera's stream does not answer yet.
            DeviceError: the camera cannot be opened, or the base is none.
        """
        check_base(base)
        self._base = base
        self._settings = settings
        self._description: RobotDescription | None = None
        self._changed = threading.Condition()
        self._readings: deque[tuple[int, BaseReading]] = deque(maxlen=64)
        # Since the last observation: a short touch must not fall between two of them.
        self._bumped = self._kidnapped = False
        self._command: Wheels | None = None
        self._failure = ""
        self._mistake: BaseException | None = None
        self._opened = self._closing = False
        self._answered = 0.0
        self._stamp_ns = 0
        self._age_ns = OLDEST_IMAGE_NS
        self._odometry_at = Wheels()
        self._due = 0.0
        if camera is None:
            if settings.camera is None:
                settings.describe(base.geometry)  # raises SettingsError
                raise AssertionError
            camera = Capture(settings.camera)
        self._camera = camera
        self._thread = threading.Thread(target=self._serve, name="base", daemon=True)
        self._thread.start()
        self.initialized = True

    def describe(self) -> RobotDescription:
        """Combine settings and driver; waits for the first answer of the base.

        Raises:
            DeviceError: the base does not answer, or its driver has raised an error.
            SettingsError: a dimension of the robot is missing.
        """
        if self._description is None:
            with self._changed:
                self._changed.wait_for(
                    lambda: bool(self._readings or self._mistake) or self._closing, PATIENCE
                )
                self._raise_mistake()
                if not self._readings:
                    silent = f"the robot's base has not answered for {PATIENCE:g} s"
                    closed = "the robot was closed before it has answered"
                    raise DeviceError(self._failure or (closed if self._closing else silent))
                read_ns, reading = self._readings[-1]
                self._stamp_ns = read_ns - self._age_ns
                self._odometry_at = reading.way
            self._description = self._put_together()
        return self._description

    def sense(self) -> Observation | None:
        """Return the newest image one tick after the last call; None once closed.

        While the line has failed, the odometry is zero and the proximity readings are missing.

        Raises:
            DeviceError: the base has never answered, or its driver has raised an error.
        """
        description = self.describe()
        tick = description.tick
        begin = time.monotonic()
        self._due = max(self._due + tick, begin)
        with self._changed:
            if self._changed.wait_for(lambda: self._closing, self._due - begin):
                return None
        frame = self._camera.newer(self._stamp_ns, tick)
        with self._changed:
            if self._closing:
                return None
            self._raise_mistake()
            if not self._failure and time.monotonic() - self._answered > SILENT:
                # Else its thread has said what is wrong.
                self._fail(f"the robot's base has not answered for {SILENT:g} s")
            if frame is not None and not isinstance(frame, StampedImage):
                raise mistake("camera: newer()", f"must return a Frame or None, not {kind_of(frame)}")
            if frame is not None:
                stamp_ns = frame.stamp_ns
                self._age_ns = now_ns() - stamp_ns
            else:
                # The stamp of an image one tick ago, so that the next image is newer.
                tick_ns = round(tick * 1e9)
                stamp_ns = max(self._stamp_ns + tick_ns // 10, now_ns() - self._age_ns - tick_ns)
            way = self._way(stamp_ns)
            read_ns, reading = self._readings[-1]
            bumped, kidnapped, silent = self._bumped, self._kidnapped, self._failure
            self._bumped, self._kidnapped = reading.bumped, reading.kidnapped
        before, self._odometry_at = self._odometry_at, way
        self._stamp_ns = stamp_ns
        left, right = way.left - before.left, way.right - before.right
        fresh = now_ns() - read_ns < STALE * 1e9
        # Settings without ranger bearings leave the sensors of the base unused.
        used = fresh and bool(description.ranger_bearings)
        return Observation(
            stamp_ns,
            Odometry((left + right) / 2, (right - left) / description.axle),
            None if frame is None else frame.image,
            reading.proximity if used else np.zeros(0),
            bumped and fresh,
            reading.battery,
            kidnapped and fresh,
            silent=silent,
        )

    def act(self, command: Command) -> Command:
        """Pass a command to the thread of the base.

        Returns:
            The applied command: within the limits, in the steps of the hardware.

        Raises:
            InvalidValue: the command is not finite.
        """
        wheels = self._base.nearest(self._wheels(command))
        check_wheels("nearest()", wheels)
        with self._changed:
            self._command = wheels
            self._changed.notify_all()
        axle = self.describe().axle
        return Command((wheels.left + wheels.right) / 2, (wheels.right - wheels.left) / axle)

    def close(self) -> None:
        """Stop the wheels and release base and camera. May be called twice."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(2.0)
        self._camera.close()

    def _put_together(self) -> RobotDescription:
        """Description of the robot, once the base has answered."""
        geometry = self._base.geometry
        if not isinstance(geometry, Geometry):
            raise mistake("geometry", f"of the base must be a Geometry, not {kind_of(geometry)}")
        return self._settings.describe(geometry)

    def _raise_mistake(self) -> None:
        """Raise what the base's thread has ended by."""
        if isinstance(self._mistake, DeviceError):
            raise self._mistake
        if self._mistake is not None:
            raise driver_error(self._mistake) from self._mistake

    def _wheels(self, command: Command) -> Wheels:
        """Wheel speeds of a command within the limits."""
        d = self.describe()
        safe = clip(command, d)
        half = safe.turn * d.axle / 2
        return Wheels(safe.forward - half, safe.forward + half)

    def _way(self, stamp_ns: int) -> Wheels:
        """Distances of the wheels at a time, interpolated or slightly extrapolated."""
        stamps = np.array([stamp for stamp, _ in self._readings], dtype=np.int64)
        # (N, 2) m. Relative stamps: nanoseconds since 1970 are too many for a float.
        ways = np.array([reading.way for _, reading in self._readings])
        times: NDArray[np.float64] = (stamps - stamps[-1]).astype(np.float64)
        at = float(stamp_ns - int(stamps[-1]))
        if at > 0.0 and len(ways) > 1:
            speed = (ways[-1] - ways[-2]) / max(times[-1] - times[-2], 1.0)
            left, right = ways[-1] + speed * min(at, LONGEST_EXTRAPOLATION_NS)
        else:
            left, right = (float(np.interp(at, times, ways[:, wheel])) for wheel in (0, 1))
        return Wheels(float(left), float(right))

    # In the base's thread.

    def _serve(self) -> None:
        while not self._closing:
            try:
                self._connected()
            # An exit would end this thread alone, and the robot would seem to stand.
            except (Exception, SystemExit) as error:  # noqa: BLE001 - raised again by `sense`
                with self._changed:
                    self._mistake = error
                    self._changed.notify_all()
                return
            with self._changed:
                self._changed.wait_for(lambda: self._closing, RETRY)

    def _connected(self) -> None:
        """Open the base and exchange with it until the line fails, or the robot is closed."""
        try:
            self._base.open()
            while not self._closing:
                self._exchange()
        except DriverMistake:
            raise
        except DeviceError as error:
            self._fail(str(error))
        finally:
            self._base.close()

    def _exchange(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._command is not None or self._closing, POLL)
            command, self._command = self._command, None
        if self._closing:
            return
        if command is not None:
            self._base.drive(command)
        asked = now_ns()
        reading = self._base.read()
        check_reading(reading)
        stamp_ns = (asked + now_ns()) // 2 if reading.stamp_ns is None else reading.stamp_ns
        with self._changed:
            if self._readings and stamp_ns <= self._readings[-1][0]:
                # The wheels' newest way is known; what the other sensors say may be news.
                stamp_ns, known = self._readings.pop()
                reading = replace(reading, way=known.way)
            self._readings.append((stamp_ns, reading))
            self._bumped |= reading.bumped
            self._kidnapped |= reading.kidnapped
            if self._failure and self._opened:
                log.warning("the robot answers again")
            self._opened, self._failure, self._answered = True, "", time.monotonic()
            self._changed.notify_all()

    def _fail(self, failure: str) -> None:
        if self._opened and not self._failure:
            log.warning("%s; the robot stands until it answers again", failure)
        self._failure = failure
        # An earlier command must not be driven after the reconnection.
        self._command = None
