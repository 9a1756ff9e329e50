"""What the robot keeps of its way between two nodes, for those who ask where it was when."""

import numpy as np

from mapweave.agent.mapping.way_correction import scaled
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import FURTHEST, LONGEST, MOST, TrajectorySegment

PERIOD = 1.0
"""Time between two kept moments, s; twice as long whenever a segment grows too long."""


class TrajectoryRecorder:
    """Moments since the last node, seen from the mapper's anchor.

    Times of a robot whose clock has no name cannot be compared: it keeps nothing.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Nothing yet."""
        self._description = description
        self.clear(0)

    def clear(self, stamp_ns: int) -> None:
        """Drop all moments: they belong to a node now, or their poses are lost.

        Args:
            stamp_ns: of the anchor's image, which needs no moment of its own.
        """
        self._newest = stamp_ns
        self._stamps: list[int] = []
        self._poses: list[Pose2] = []
        self._readings: list[Array] = []
        self._period = PERIOD

    def step(self, observation: Observation, anchor_from_robot: Pose2) -> None:
        """Keep this moment, if it is time."""
        if not self._description.clock or observation.stamp_ns - self._newest < self._period * 1e9:
            return
        self._newest = observation.stamp_ns
        self._stamps.append(observation.stamp_ns)
        self._poses.append(anchor_from_robot)
        self._readings.append(observation.proximity)
        if len(self._stamps) > MOST:
            for column in (self._stamps, self._poses, self._readings):
                del column[1::2]
            self._period *= 2.0

    def move_anchor(self, old_from_new: Pose2) -> None:
        """What comes is seen from the next anchor; so must be what was kept."""
        new_from_old = old_from_new.inverse()
        self._poses = [new_from_old @ pose for pose in self._poses]

    def rescale(self, scale: float) -> None:
        """Wheels have gone further, by a factor, than was assumed since the last node."""
        self._poses = [scaled(pose, scale) for pose in self._poses]

    def segment(self, stamp_ns: int, ranges: Ranges) -> TrajectorySegment:
        """What was kept, for a node at the anchor.

        Args:
            stamp_ns: of the node's image.
            ranges: what its proximity sensors saw; without any, the segment has no readings.
        """
        if not self._stamps:
            return TrajectorySegment()
        ages = (np.array(self._stamps, np.int64) - stamp_ns) * 1e-9
        poses = np.array([pose.vector for pose in self._poses])
        distances = np.zeros((len(ages), len(ranges)))
        for k, readings in enumerate(self._readings):
            # A missing reading is like an obstacle at the sensor: nothing is known behind it.
            distances[k] = (
                ranges_.distances
                if len(ranges_ := self._description.ranges(readings)) == len(ranges)
                else 0.0
            )
        good = (np.abs(ages) < LONGEST) & (np.abs(poses[:, :2]) < FURTHEST).all(axis=1)
        return TrajectorySegment(ages[good], poses[good], distances[good])
