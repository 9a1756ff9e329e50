"""Driving without a view: turn to the goal's position, drive straight, turn to its heading."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.servo.laws import saturate
from mapweave.agent.servo.leg_controller import clip
from mapweave.agent.servo.servo_step import ServoStep, State
from mapweave.hybridmap.pose import Pose2, wrap_angle

POSITION_TOLERANCE = 0.02
"""Nearer than this the robot only turns, m."""
HEADING_TOLERANCE = 0.02
"""Of the last turn, rad."""
FORWARD_GAIN = 1.5
"""Gain that slows the drive toward its end, 1/s."""
TURN_GAIN = 2.5
"""Gain of turns, 1/s."""
CLEARANCE = 0.04
"""Room between the footprint and obstacle points below which the drive stops, m."""
CRUISE = 0.8
"""Share of the speed limits that is used."""
PATIENCE_TICKS = 20
"""Ticks that an obstacle in the way is waited for before the drive is stuck."""


class OdometryDrive:
    """Turn, drive, turn. For edges whose far end is not in view, such as turns on the spot.

    The pose it is given comes from odometry or a filter; it is corrected whenever that is.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Prepare for a robot; `start` must come before each drive."""
        self._description = description
        self._max_forward = max(description.max_forward, 1e-3) * CRUISE
        self._max_turn = max(description.max_turn, 1e-3) * CRUISE
        self.start(Pose2())

    def start(self, goal_from_robot: Pose2) -> None:
        """Begin a drive: forward or backward is decided once, by which needs less turning in all."""
        self._blocked = 0
        self._at_goal = False
        toward = math.atan2(-goal_from_robot.y, -goal_from_robot.x)
        ahead = _turning(goal_from_robot.heading, toward)
        astern = _turning(goal_from_robot.heading, toward + math.pi)
        self._direction = -1.0 if astern < ahead - 1e-6 else 1.0
        self._aligned = False

    def command(self, goal_from_robot: Pose2, obstacles: NDArray[Any]) -> ServoStep:
        """One tick.

        Args:
            goal_from_robot: where the robot is now, in the goal's robot frame.
            obstacles: (K, 2) m, in robot, points that the rangers hit now.
        """
        pose = goal_from_robot
        rho = math.hypot(pose.x, pose.y)
        heading = wrap_angle(pose.heading)
        reach = POSITION_TOLERANCE * (2.0 if self._at_goal else 1.0)
        self._at_goal = rho <= reach
        if self._at_goal:
            if abs(heading) <= HEADING_TOLERANCE:
                return _step(Command(), "arrived", "at the goal")
            turn = clip(-TURN_GAIN * heading, self._max_turn)
            return _step(Command(0.0, turn), "turning", "turning to the goal's heading")
        toward = math.atan2(-self._direction * pose.y, -self._direction * pose.x)
        error = wrap_angle(toward - heading)
        if (
            rho < 0.1 and abs(error) > 0.5 * math.pi
        ):  # just driven past the goal: come back, do not turn about
            self._direction = -self._direction
            error = wrap_angle(error - math.pi)
        in_the_way = self._in_the_way(obstacles, min(rho, 0.25), error)
        if self._blocked > PATIENCE_TICKS and in_the_way:
            # It gets no nearer. With the goal's heading it may see the goal, and know better where that is.
            turn = clip(-TURN_GAIN * heading, self._max_turn) if abs(heading) > HEADING_TOLERANCE else 0.0
            return _step(Command(0.0, turn), "stuck", "an obstacle is in the way")
        if abs(error) > (0.3 if self._aligned else 0.05):
            self._aligned = False
            return _step(
                Command(0.0, clip(TURN_GAIN * error, self._max_turn)),
                "turning",
                "turning to drive " + ("forward" if self._direction > 0 else "backward"),
            )
        self._aligned = True
        if in_the_way:
            self._blocked += 1
            return _step(Command(), "driving", "an obstacle is in the way")
        self._blocked = 0
        speed = self._direction * min(max(FORWARD_GAIN * rho, 0.015), self._max_forward)
        speeds = saturate(speed, TURN_GAIN * error, self._max_forward, self._max_turn)
        return _step(Command(*speeds), "driving", "driving straight to the goal")

    def _in_the_way(self, obstacles: NDArray[Any], way: float, error: float) -> bool:
        """Whether the footprint, turned by `error` (rad) and driven `way` (m), comes too near a point."""
        points = Pose2(heading=error).inverse().apply(np.asarray(obstacles, dtype=np.float64).reshape(-1, 2))
        along, aside = self._direction * points[:, 0], points[:, 1]
        beyond = np.maximum(along - way, 0.0)
        near = np.hypot(beyond, aside) < self._description.radius + CLEARANCE
        return bool((near & (along > 0.0)).any())


def _step(command: Command, state: State, reason: str) -> ServoStep:
    return ServoStep(command, state, None, reason)


def _turning(heading: float, toward: float) -> float:
    """Turning in all, rad: from a heading to the direction of the drive, and from there to 0."""
    return abs(wrap_angle(toward - heading)) + abs(wrap_angle(toward))
