"""Proximity sensors: rays in the physics, of all robots in one question."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.physics import Physics

HEIGHT = 0.12
"""Of the sensors above the floor, m."""
GAP = 1e-3
"""Rays start this far outside of the robot's edge, so that they do not meet the robot itself, m."""


class Rangers:
    """The rangers of one robot: where its rays go, and what it reads from them."""

    def __init__(self, description: RobotDescription, noise: float, seed: Sequence[int]) -> None:
        """Mount them.

        Args:
            description: bearings and reach.
            noise: standard deviation of a range, as a share of it.
            seed: of the noise.
        """
        self._bearings = np.array(description.ranger_bearings)
        self._radius = description.radius
        self.reach = description.ranger_reach
        self._noise = noise
        self._rng = np.random.default_rng(seed)
        self._shares: Array = np.ones(len(self._bearings))

    def rays(self, pose: Pose2) -> tuple[Array, Array]:
        """(K, 3) m where rays start, and (K, 3) m where they end at the latest, in world."""
        angles = pose.heading + self._bearings
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
        origin = np.array([pose.x, pose.y, HEIGHT])
        return origin + directions * (self._radius + GAP), origin + directions * (self._radius + self.reach)

    def take(self, shares: NDArray[np.float64]) -> None:
        """Keep what the rays met, (K,) as a share of their length, 1 for nothing."""
        self._shares = shares

    def read(self) -> Array:
        """(K,) m from the robot's edge, with fresh noise."""
        ranges = GAP + self._shares * (self.reach - GAP)
        ranges = ranges * (1.0 + self._noise * self._rng.standard_normal(len(ranges)))
        return np.where(self._shares >= 1.0, self.reach, np.clip(ranges, 0.0, self.reach))


def cast(physics: Physics, rangers: Sequence[Rangers], poses: Sequence[Pose2]) -> None:
    """Let all robots' rangers feel their surroundings, in one batch of rays."""
    rays = [robot_rangers.rays(pose) for robot_rangers, pose in zip(rangers, poses, strict=True)]
    starts = np.concatenate([start for start, _ in rays])
    if not len(starts):
        return
    hits = physics.rayTestBatch(starts.tolist(), np.concatenate([end for _, end in rays]).tolist())
    shares = np.array([hit[2] for hit in hits])
    ends = np.cumsum([len(start) for start, _ in rays])
    for robot_rangers, some in zip(rangers, np.split(shares, ends[:-1]), strict=True):
        robot_rangers.take(some)
