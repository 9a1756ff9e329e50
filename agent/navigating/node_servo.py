"""Servoing to a node in sight: by its landmarks' depths, or by their bearings where it has none."""

from __future__ import annotations

import numpy as np

from agent.homing.localizer import BearingLocalizer
from agent.localizing.localizer import Localizer
from agent.observation import RobotDescription
from agent.servo.appearance import AppearanceServo
from agent.servo.step import ServoStep
from agent.servo.supervisor import Servo
from hybridmap.pose import Array, Pose2


class NodeServo:
    """Holds a servo of either kind, and starts the right one when it is needed.

    Attributes:
        leg: what is driven to; -1 if something else has the wheels.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Prepare for a robot."""
        self._servo = Servo(description)
        self._appearance = AppearanceServo(description)
        self.leg = -1
        self._kind: type = type(None)

    def over(self) -> None:
        """Something else has the wheels: the next drive begins anew."""
        self.leg = -1

    def command(
        self, leg: int, localizer: Localizer | BearingLocalizer, target_from_robot: Pose2, obstacles: Array
    ) -> ServoStep:
        """One tick toward a node.

        Args:
            leg: number by which the caller knows the node; another one begins another drive.
            localizer: follows the node's landmarks.
            target_from_robot: where the robot is from the node; a localizer that knows bearings only says so
                itself.
            obstacles: (K, 2) m, in robot, points that the rangers hit now.
        """
        fresh = leg != self.leg or type(localizer) is not self._kind
        self.leg, self._kind = leg, type(localizer)
        visible = np.zeros(len(localizer.node.landmarks), np.bool_)
        visible[localizer.visible] = True
        if isinstance(localizer, BearingLocalizer):
            pose, points = localizer.pose, localizer.points_in_node
            if fresh:
                self._appearance.start(pose, points)
            return self._appearance.command(pose, points, visible, obstacles)
        points = localizer.node.points_in_robot
        if fresh:
            self._servo.start(target_from_robot, points)
        return self._servo.command(target_from_robot, points, visible, obstacles)
