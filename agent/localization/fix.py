"""The robot's pose with respect to a node of the map, updated while it moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian, nearest_covariance

CONTRADICTION = 11.34
"""Two estimates further apart than this contradict each other: chi-square, 99 % point for 3 degrees of
freedom."""
TURN_SHARE = 0.15
"""m/rad; a turn without visible landmarks adds as much uncertainty as this way."""


@dataclass(eq=False)
class Fix:
    """Where the robot is with respect to a node: by the node's visible landmarks, else by the wheels.

    Attributes:
        node: the node's id.
        node_from_robot: pose.
        localizer: follows the node's landmarks; None if they are unknown or not visible.
        blind: way since landmarks were last visible, m.
    """

    node: NodeId
    node_from_robot: PoseGaussian
    localizer: NodeLocalizer | None = None
    blind: float = 0.0

    @staticmethod
    def of(localizer: NodeLocalizer) -> Fix:
        """A fix on a node whose landmarks are visible."""
        return Fix(localizer.node.id, localizer.pose, localizer)

    @property
    def in_sight(self) -> bool:
        """Whether the node's landmarks are visible."""
        return self.localizer is not None and self.localizer.in_sight

    def follow(self, observation: Observation, description: RobotDescription) -> None:
        """Take in what the robot senses."""
        if self.localizer is not None:
            self.localizer.step(observation)
            if self.localizer.in_sight:
                self.node_from_robot, self.blind = self.localizer.pose, 0.0
                return
        self.follow_wheels(observation, description)

    def follow_wheels(self, observation: Observation, description: RobotDescription) -> None:
        """Take in what the wheels say; landmarks are no longer looked for."""
        self.localizer = None
        step, blind = wheel_step(observation.odometry, description)
        self.node_from_robot, self.blind = self.node_from_robot @ step, self.blind + blind


def wheel_step(odometry: Odometry, description: RobotDescription) -> tuple[PoseGaussian, float]:
    """One step by wheels alone: `before_from_after`, and the blind way that it counts for, m."""
    axle = description.axle
    way = description.wheel_noise * (abs(odometry.forward) + abs(odometry.turn) * axle)
    step = PoseGaussian.from_sigmas(odometry.motion(), way + 1e-5, way / axle + 1e-5)
    return step, abs(odometry.forward) + TURN_SHARE * abs(odometry.turn)


def position_sigma(pose: PoseGaussian) -> float:
    """Standard deviation of a position in the direction in which it is known least, m."""
    widest = float(np.linalg.eigvalsh(pose.covariance[:2, :2])[-1])
    return math.sqrt(max(widest, 0.0))


def joined(measured: PoseGaussian, followed: PoseGaussian) -> PoseGaussian:
    """One pose from a measurement and from what was followed until then, weighted by their information.

    They use different pixels of the same landmarks. What errors these have in common does not average out;
    that is no reason to drop either, and both are estimated with care.

    Args:
        measured: by a view of its own.
        followed: by tracks, which may have slid, all in the same direction.

    Returns:
        The pose; the measurement alone if the tracks contradict it.
    """
    apart = (measured.mean.inverse() @ followed.mean).vector
    together = measured.covariance + followed.covariance + 1e-12 * np.eye(3)
    if float(apart @ np.linalg.solve(together, apart)) > CONTRADICTION:
        return measured
    gain = measured.covariance @ np.linalg.inv(together)
    covariance = measured.covariance - gain @ measured.covariance
    step = Pose2.from_vector(gain @ apart)
    return PoseGaussian(measured.mean @ step, nearest_covariance(0.5 * (covariance + covariance.T)))
