"""Polar coordinates of the robot about the goal, equation (2) of the paper."""

import math
from dataclasses import dataclass

from mapweave.hybridmap.pose import Pose2, wrap_angle

TURN = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class Polar:
    """Pose of the robot in polar coordinates around the goal.

    Attributes:
        rho: distance to the goal, m.
        phi: direction of the robot from the goal, rad, in the goal's frame.
        beta: pi + phi - heading, rad: 0 when the robot faces the goal, +-pi when its back does.
    """

    rho: float
    phi: float
    beta: float

    def pose(self) -> Pose2:
        """The pose `goal_from_robot` with these coordinates."""
        heading = wrap_angle(math.pi + self.phi - self.beta)
        return Pose2(self.rho * math.cos(self.phi), self.rho * math.sin(self.phi), heading)


def polar_of(goal_from_robot: Pose2) -> Polar:
    """Coordinates with phi in [0, 2 pi) and beta in [-pi, pi).

    The cut of phi lies ahead of the goal: a robot that comes from behind (phi near pi, the usual way) never
    crosses it, and the four laws that come from ahead have a chart on either side of it.
    """
    rho = math.hypot(goal_from_robot.x, goal_from_robot.y)
    phi = math.atan2(goal_from_robot.y, goal_from_robot.x) % TURN
    return Polar(rho, phi, wrap_angle(math.pi + phi - goal_from_robot.heading))


def continued(goal_from_robot: Pose2, before: Polar) -> Polar:
    """Coordinates on the branch that continues `before`, so that a law that goes on sees no jump."""
    polar = polar_of(goal_from_robot)
    return Polar(
        polar.rho,
        before.phi + wrap_angle(polar.phi - before.phi),
        before.beta + wrap_angle(polar.beta - before.beta),
    )
