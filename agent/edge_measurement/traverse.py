"""Traverses: relative poses of nodes, measured on a drive that passes them.

At a hand-over the robot is localized by the landmarks of one node, and a moment later by those of the next:
two poses of the same robot measure the relative pose of the two nodes.
"""

from dataclasses import dataclass

import numpy as np

from mapweave.agent.localization.fix import Fix, wheel_step
from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian

HERE = PoseGaussian(Pose2(), np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Traverse:
    """The robot was at one node, and then at another.

    Attributes:
        start: the first node.
        end: the second.
        start_from_end: as measured on the way.
        landmarks: fewest visible at a hand-over from one node to the next.
    """

    start: NodeId
    end: NodeId
    start_from_end: PoseGaussian
    landmarks: int


FLOOR = (0.005, 0.005)
"""Error of a settled pose that its covariance does not tell of, m and rad: tracks err alike for a while,
and the landmarks of a node were mapped by the same wheels."""
WIDEST = 0.1
"""A traverse known no better than this is not worth telling, m."""
SETTLED = 3
"""Images through which a node's landmarks must have been followed: fewer than lie between two looks for the
next node."""
MOST_BLIND = 0.5
"""What may lie between the landmarks of two nodes, as `Fix.blind` counts it, m."""
REACH = 0.45
"""This near to a node the robot has passed it, m. It is twice the distance within which the follower takes
a node for passed."""
DETOUR = 1.3
"""A traverse on a way longer than the straight line by more than this factor, and REACH at either end, is
not worth telling: something stands in between."""


class TraverseRecorder:
    """Watches the robot's fixes and reports when it has driven from one node to another.

    In between it may localize by nodes that it does not come near to. It measures nothing across a long gap
    without landmarks, nor from where the robot was lost.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Start with no node passed."""
        self._description = description
        self._watched: NodeLocalizer | None = None
        self._images = 0
        self._forget()

    def _forget(self) -> None:
        self._node: NodeId | None = None
        self._node_from_robot = HERE
        self._gap = 0.0
        self._visible = 0
        self._passed: NodeId | None = None
        self._passed_from_node = HERE
        self._fewest, self._way = 0, 0.0

    def see(self, fix: Fix | None, observation: Observation) -> Traverse | None:
        """Take in one tick of a drive.

        Args:
            fix: where the robot is after this observation; None while it is lost, or localizes globally.
            observation: with the wheels' last step.

        Returns:
            A traverse that ends here.
        """
        if fix is None:
            self._forget()
            return None
        step, blind = wheel_step(observation.odometry, self._description)
        self._node_from_robot, self._gap = self._node_from_robot @ step, self._gap + blind
        self._way += abs(observation.odometry.forward)
        if not self._settled(fix):
            if self._gap > MOST_BLIND:
                self._forget()
            return None
        assert fix.localizer is not None, "landmarks are visible"
        self._set_reference_node(fix.node, self._with_floor(fix.node_from_robot), len(fix.localizer.visible))
        mean = self._node_from_robot.mean
        return self._arrive() if mean.distance(Pose2()) <= REACH else None

    def _settled(self, fix: Fix) -> bool:
        """Whether landmarks of the node with known depths have been visible for a while."""
        localizer = fix.localizer if fix.in_sight else None
        same_localizer = localizer is not None and localizer is self._watched
        self._images = self._images + 1 if same_localizer else 0
        self._watched = localizer
        return same_localizer and self._images >= SETTLED

    def _set_reference_node(self, node: NodeId, node_from_robot: PoseGaussian, visible: int) -> None:
        """Localize by a node; if it is another node than before, this is a hand-over."""
        if self._node is None:
            self._fewest = visible
        elif node != self._node:
            before_from_node = self._node_from_robot @ node_from_robot.inverse()
            self._passed_from_node = self._passed_from_node @ before_from_node
            self._fewest = min(self._fewest, self._visible, visible)
        self._node, self._node_from_robot = node, node_from_robot
        self._gap, self._visible = 0.0, visible

    def _arrive(self) -> Traverse | None:
        """The robot is at the node by which it is localized."""
        assert self._node is not None
        start, between, fewest, way = self._passed, self._passed_from_node, self._fewest, self._way
        self._passed, self._passed_from_node = self._node, HERE
        self._fewest, self._way = self._visible, 0.0
        if start is None or start == self._node:
            return None
        widest = float(np.sqrt(np.linalg.eigvalsh(between.covariance[:2, :2])[-1]))
        straight = DETOUR * between.mean.distance(Pose2()) + 2.0 * REACH
        return Traverse(start, self._node, between, fewest) if widest < WIDEST and way < straight else None

    def _with_floor(self, pose: PoseGaussian) -> PoseGaussian:
        """A pose of the filter with the uncertainty that the filter cannot know."""
        xy, heading = FLOOR
        more: Array = np.diag([xy**2, xy**2, heading**2])
        return PoseGaussian(pose.mean, pose.covariance + more)
