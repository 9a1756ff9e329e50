"""All sensors of a robot: which cannot be believed, and the small turn that shows whether it can again."""

import math
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import same_image
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.agent.ranger_monitor import RangerMonitor
from mapweave.agent.sensor_health.clock_monitor import ClockMonitor
from mapweave.agent.sensor_health.encoder_monitor import EncoderMonitor
from mapweave.hybridmap.pose import Pose2

LATEST = 0.5
"""s without a new image after which the robot stands. It drives 0.15 m in that time."""
DROPPED = 3
"""Images in a row that any camera may drop."""
MOVED = (0.02, 0.02)
"""Once the wheels have moved this much, m and rad, no camera gives the same image to the last grey level: a
turn by 0.02 rad moves it by 5 px at 320 px."""
BLACK, WHITE = 16.0, 250.0
"""Mean grey levels beyond which an image is all black or white,"""
EVEN = 4.0
"""if it varies by less than this, grey levels. A dim room varies more; a white wall is below `WHITE`."""


class CameraMonitor:
    """Compares each image with the one before and with the wheels.

    A robot that stands before a scene that stands may get the same image for ever: that is no fault.

    Attributes:
        fault: what is wrong, in words; empty if nothing is.
        frozen: whether the last image came before, from elsewhere: it shows nothing of the present.
    """

    def __init__(self, tick: float) -> None:
        """Begin without an image.

        Args:
            tick: time between two observations, s.
        """
        self.fault = ""
        self.frozen = False
        self._tick = tick
        self._patience = max(LATEST, DROPPED * tick)
        self._image: NDArray[np.uint8] | None = None
        self._moved = Pose2()
        self._missing = self._stale = self._empty = 0.0

    def see(self, image: NDArray[np.uint8] | None, odometry: Odometry) -> None:
        """Take in one tick: its image, (H, W) grey or None, and how the wheels have moved."""
        self._moved = self._moved @ odometry.motion()
        if image is None:
            self._missing += self._tick
        else:
            self._missing = 0.0
            self._compare(image)
        self.fault = self._found(image)

    def _compare(self, image: NDArray[np.uint8]) -> None:
        """Whether an image is the last one again, and whether it shows anything."""
        if self._image is not None and same_image(image, self._image):
            way = math.hypot(self._moved.x, self._moved.y)
            moved = way > MOVED[0] or abs(self._moved.heading) > MOVED[1]
            # Only an image with nothing in it is the same from everywhere. A frozen one is until it changes.
            self.frozen = self.frozen or (moved and int(image.min()) < int(image.max()))
        else:
            self._image, self._moved, self.frozen = image, Pose2(), False
        self._stale = self._stale + self._tick if self.frozen else 0.0
        means, spreads = cv2.meanStdDev(image)
        mean, spread = float(means[0, 0]), float(spreads[0, 0])
        empty = spread < EVEN and not BLACK <= mean <= WHITE
        self._empty = self._empty + self._tick if empty else 0.0

    def _found(self, image: NDArray[np.uint8] | None) -> str:
        if self._missing > self._patience:
            return "the camera gives no image: is it connected?"
        if self._stale > self._patience:
            return "the camera gives the same image again and again while the wheels move: it is frozen"
        if image is None:
            return self.fault
        if self._empty > self._patience:
            kind = "black" if float(image.mean()) < BLACK else "white"
            return f"the camera's image is all {kind}: is the lens covered, or the light off or too strong?"
        return ""


FIRST_TRIAL, LAST_TRIAL = 3.0, 30.0
"""s from a fault to the first trial turn; each further pause is twice as long, up to the last."""
TRIAL_RATE, TRIAL_SIDE = 0.5, 0.5
"""rad/s and s: a trial turn goes to the left for so long and back; it moves no round footprint."""


MOST_SKIPPED = 100.0
"""Ticks between two observations."""


class SensorFault(NamedTuple):
    """A sensor that cannot be believed.

    Attributes:
        sensor: clock, camera, encoders or rangers.
        words: what is wrong.
    """

    sensor: str
    words: str


class SensorMonitor:
    """Watches every observation of one robot.

    Attributes:
        fault: what the robot must not drive with; None if it may drive.
        rangers: whether the proximity sensors are read.
        pose_lost: whether the encoders began or ceased to fail in this tick: what was measured in between
            ties to nothing.
    """

    def __init__(self, description: RobotDescription) -> None:
        """All sensors are healthy."""
        self.fault: SensorFault | None = None
        self.rangers = RangerMonitor(description)
        self.pose_lost = False
        self._tick = description.tick
        self._camera = CameraMonitor(description.tick)
        self._clock = ClockMonitor(description.tick)
        self._encoders = EncoderMonitor(description)
        self._stamp_ns = 0
        self._faulty = 0.0
        self._trial_at, self._pause = FIRST_TRIAL, FIRST_TRIAL

    @property
    def clock_jumped(self) -> bool:
        """Whether the clock has ever jumped."""
        return self._clock.jumps > 0

    def see(self, observation: Observation, command: Command | None) -> Observation:
        """Take in one tick.

        Args:
            observation: as it was sensed.
            command: that the wheels had since the observation before; None if they were not the robot's own.

        Returns:
            The observation without an image that shows nothing of the present.
        """
        self._clock.see(observation.stamp_ns)
        # Images that were skipped: the wheels had the command for longer.
        ticks = (observation.stamp_ns - self._stamp_ns) * 1e-9 / self._tick if self._stamp_ns else 1.0
        self._stamp_ns = observation.stamp_ns
        self._camera.see(observation.image, observation.odometry)
        if self._camera.frozen:
            observation = replace(observation, image=None)
        ticks = 1.0 if self._clock.fault else min(max(ticks, 1.0), MOST_SKIPPED)
        self._encoders.see(observation, command, ticks)
        self.rangers.see(observation.proximity, observation.odometry)
        before, self.fault = self.fault, self._found()
        encoders = [one is not None and one.sensor == "encoders" for one in (before, self.fault)]
        self.pose_lost = encoders[0] != encoders[1]
        self._wait(before)
        return observation

    @property
    def trial(self) -> Command:
        """A small turn to and fro, now and then, by which sensors show that they are back; else to stand."""
        since = self._faulty - self._trial_at
        stuck = {"camera": self._camera.frozen, "encoders": True, "rangers": self.rangers.frozen}
        if self.fault is None or not stuck.get(self.fault.sensor) or since < 0.0:
            return Command()
        return Command(0.0, TRIAL_RATE if since < TRIAL_SIDE else -TRIAL_RATE)

    def _found(self) -> SensorFault | None:
        causes = (
            ("clock", self._clock.fault),
            ("camera", self._camera.fault),
            ("encoders", self._encoders.fault),
            ("rangers", self.rangers.fault),
        )
        return next((SensorFault(sensor, words) for sensor, words in causes if words), None)

    def _wait(self, before: SensorFault | None) -> None:
        """Count the time of a fault, and say when its next trial is."""
        if self.fault is None or before is None or self.fault.sensor != before.sensor:
            self._faulty, self._trial_at, self._pause = 0.0, FIRST_TRIAL, FIRST_TRIAL
            return
        self._faulty += self._tick
        if self._faulty >= self._trial_at + 2.0 * TRIAL_SIDE:
            self._pause = min(2.0 * self._pause, LAST_TRIAL)
            self._trial_at = self._faulty + self._pause
