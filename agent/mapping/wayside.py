"""Wayside: what the robot keeps of its way between two nodes, for those who ask where it was when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.observation import Observation, RobotDescription
from hybridmap.errors import InvalidValue
from hybridmap.pose import Array, Pose2
from hybridmap.ranges import Ranges
from hybridmap.wake import FURTHEST, LONGEST, MOST, Wake


@dataclass(frozen=True)
class WaysideSettings:
    """What is kept.

    Attributes:
        period: a moment each, s; twice as long whenever a wake grows too long.
    """

    period: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what is no time.

        Raises:
            InvalidValue: the period is not positive.
        """
        if not self.period > 0.0:
            raise InvalidValue(f"wayside: a period of {self.period:g} s; it must be more than 0")


class Wayside:
    """Moments since the last node, seen from the mapper's anchor.

    Nobody can compare the times of a robot whose clock has no name: it keeps nothing.
    """

    def __init__(self, description: RobotDescription, settings: WaysideSettings) -> None:
        """Nothing yet."""
        self._description = description
        self._settings = settings
        self.clear(0)

    def clear(self, stamp_ns: int) -> None:
        """Forget all: the moments are a node's now, or nobody knows any more where they were.

        Args:
            stamp_ns: of the anchor's image, which needs no moment beside it.
        """
        self._newest = stamp_ns
        self._stamps: list[int] = []
        self._postures: list[Pose2] = []
        self._readings: list[Array] = []
        self._period = self._settings.period

    def step(self, observation: Observation, anchor_from_robot: Pose2) -> None:
        """Keep this moment, if it is time."""
        if not self._description.clock or observation.stamp_ns - self._newest < self._period * 1e9:
            return
        self._newest = observation.stamp_ns
        self._stamps.append(observation.stamp_ns)
        self._postures.append(anchor_from_robot)
        self._readings.append(observation.proximity)
        if len(self._stamps) > MOST:
            for column in (self._stamps, self._postures, self._readings):
                del column[1::2]
            self._period *= 2.0

    def move_anchor(self, old_from_new: Pose2) -> None:
        """What comes is seen from the next anchor; so must be what was kept."""
        new_from_old = old_from_new.inverse()
        self._postures = [new_from_old @ posture for posture in self._postures]

    def wake(self, stamp_ns: int, ranges: Ranges) -> Wake:
        """What was kept, for a node at the anchor.

        Args:
            stamp_ns: of the node's image.
            ranges: what its proximity sensors saw; without any, the wake has no readings.
        """
        if not self._stamps:
            return Wake()
        ages = (np.array(self._stamps, np.int64) - stamp_ns) * 1e-9
        postures = np.array([posture.vector for posture in self._postures])
        distances = np.zeros((len(ages), len(ranges)))
        for k, one in enumerate(self._readings):
            # What is missing is as if something stood before the sensor: it tells of nothing behind.
            distances[k] = (
                seen.distances if len(seen := self._description.ranges(one)) == len(ranges) else 0.0
            )
        good = (np.abs(ages) < LONGEST) & (np.abs(postures[:, :2]) < FURTHEST).all(axis=1)
        return Wake(ages[good], postures[good], distances[good])
