"""All sensors of a robot: which cannot be believed, and the small turn that shows whether it can again."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.ranger_monitor import RangerMonitor
from mapweave.agent.sensor_health.camera_monitor import CameraMonitor
from mapweave.agent.sensor_health.clock_monitor import ClockMonitor
from mapweave.agent.sensor_health.encoder_monitor import EncoderMonitor

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
