"""What keeps a robot from its next node: where it is, and which robot it is."""

import math
from typing import NamedTuple

import numpy as np

from mapweave.agent.clearance import obstacle_words
from mapweave.agent.localization.fix import Fix
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.agent.robots_in_view import RobotBeside
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Obstacle
from mapweave.hybridmap.segments import distances

MARGIN = 0.1
"""Kept between two robots, and between a robot and what it cannot pass, m."""
NO_PROGRESS = "no progress, though nothing is near"


class Obstruction(NamedTuple):
    """One.

    Attributes:
        words: what it is.
        obstacle: where it is; None if nothing is near.
    """

    words: str
    obstacle: Obstacle | None


def obstruction(
    description: RobotDescription,
    observation: Observation,
    fix: Fix,
    robot_from_target: Pose2,
    to_goal: float,
    touched: str,
    beside: RobotBeside | None,
) -> Obstruction:
    """What is between a robot and where it drives.

    Another robot is in the way if this one would touch it on the straight way to its target. Else it is a
    point of that way right before the robot. Within its own length of the goal there is no such place:
    it would reach the goal, and bar every way there for what may be beside the robot.

    Args:
        description: of the robot.
        observation: what it senses.
        fix: where it is.
        robot_from_target: where it drives.
        to_goal: how far its goal is, m.
        touched: what it touched, in words; empty without a touch.
        beside: the robot next to it.
    """
    near = (
        f"something was touched: {touched}" if touched else obstacle_words(description, observation.proximity)
    )
    words = near or ("no progress" if beside is not None else NO_PROGRESS)
    if beside is not None:
        words += f"; {beside.words}"
        reach = description.radius + beside.radius + MARGIN
        way = np.array([[robot_from_target.x, robot_from_target.y]])
        if distances(np.array([[beside.x, beside.y]]), np.zeros((1, 2)), way)[0, 0] < reach:
            return Obstruction(words, _obstacle(fix, beside.x, beside.y, reach, beside.robot))
    if not near or to_goal < 2.0 * description.radius + MARGIN:
        return Obstruction(words, None)
    distance = math.hypot(robot_from_target.x, robot_from_target.y)
    share = min((description.radius + MARGIN) / max(distance, 1e-9), 1.0)
    ahead = share * robot_from_target.x, share * robot_from_target.y
    return Obstruction(words, _obstacle(fix, *ahead, description.radius))


def _obstacle(fix: Fix, x: float, y: float, reach: float, robot: str = "") -> Obstacle:
    """The obstacle at a position in the robot's frame."""
    at = fix.node_from_robot.mean @ Pose2(x, y)
    return Obstacle(fix.node, at.x, at.y, reach, robot)
