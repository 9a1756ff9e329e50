"""Plans: straight legs along the robot's own axis with turns on the spot between them.

Of the extremals of the shortest path in view of a landmark (turns on the spot, straight lines, logarithmic
spirals; Bhattacharya, Murrieta-Cid and Hutchinson 2007, Salaris et al. 2010) the first two are kept: a spiral
is met by a few legs, and a leg can be tracked and resumed from anywhere.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.servo.field_of_view import FieldOfView
from mapweave.hybridmap.pose import Array, Pose2

TURN_STEP = 0.05
"""rad between two samples of a turn on the spot."""

LEG_STEP = 0.04
"""m between two samples of a leg."""

TURN_PRICE = 0.12
"""What a plan costs in addition to its length, m a radian: with less to turn it is driven sooner and kept to
better,"""

LEG_PRICE = 0.05
"""and so it is with a leg less, m a leg."""


@dataclass(frozen=True, slots=True)
class Leg:
    """A straight drive.

    Attributes:
        heading: of the robot, rad, in goal, on the same branch as the plan's other headings.
        direction: 1 forward, -1 backward.
        x: m, where it ends, in goal.
        y: m, where it ends, in goal.
        length: m.
    """

    heading: float
    direction: float
    x: float
    y: float
    length: float


@dataclass(frozen=True, slots=True)
class ServoPlan:
    """A way to the goal pose.

    Attributes:
        start: where it begins, in goal; the heading's branch is that of the legs.
        legs: driven one after another, each after a turn on the spot to its heading.
        cost: length, turns and legs, m.
        margin: rad, slack that it keeps.
    """

    start: Pose2
    legs: tuple[Leg, ...]
    cost: float
    margin: float

    @property
    def length(self) -> float:
        """Driven, m."""
        return sum(leg.length for leg in self.legs)


def sample(start: Pose2, legs: Sequence[Leg]) -> Array:
    """(M, 3) dense poses from a start along legs to the goal's heading (the turn of it nearest)."""
    parts = []
    start_vector = start.vector
    for leg in legs:
        turned = np.array([start_vector[0], start_vector[1], leg.heading])
        end_vector = np.array([leg.x, leg.y, leg.heading])
        parts += [_between(start_vector, turned), _between(turned, end_vector)]
        start_vector = end_vector
    final = start_vector.copy()
    final[2] = 2.0 * math.pi * round(start_vector[2] / (2.0 * math.pi))
    parts.append(_between(start_vector, final))
    return np.concatenate(parts)


def _between(a: Array, b: Array) -> Array:
    way, turn = math.hypot(b[0] - a[0], b[1] - a[1]), abs(b[2] - a[2])
    count = 2 + int(max(way / LEG_STEP, turn / TURN_STEP))
    return a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)


def cost_of(start: Pose2, legs: Sequence[Leg]) -> float:
    """Cost of legs from a start, m."""
    headings = [start.heading, *(leg.heading for leg in legs)]
    headings.append(2.0 * math.pi * round(headings[-1] / (2.0 * math.pi)))
    turned = sum(abs(b - a) for a, b in pairwise(headings))
    return sum(leg.length for leg in legs) + TURN_PRICE * turned + LEG_PRICE * len(legs)


class Surroundings:
    """Which poses are allowed: enough landmarks in view, and clear of obstacles."""

    def __init__(self, field: FieldOfView, obstacles_in_goal: NDArray[Any], clearance: float) -> None:
        """Join a field of view and obstacles.

        Args:
            field: of view.
            obstacles_in_goal: (K, 2) m, points that must not be touched, in goal.
            clearance: m, least distance of the robot's origin from an obstacle point.
        """
        self.field = field
        self.obstacles = np.asarray(obstacles_in_goal, dtype=np.float64).reshape(-1, 2)
        self.clearance = clearance

    def distance(self, poses: NDArray[Any]) -> Array:
        """(...) m from the nearest obstacle point; infinite without any."""
        if not len(self.obstacles):
            return np.full(np.shape(poses)[:-1], np.inf)
        dx = poses[..., 0, None] - self.obstacles[:, 0]
        dy = poses[..., 1, None] - self.obstacles[:, 1]
        distance: Array = np.sqrt((dx * dx + dy * dy).min(axis=-1))
        return distance

    def allowed(self, poses: NDArray[Any], margin: float) -> NDArray[np.bool_]:
        """(...) whether poses (..., 3) in goal keep both constraints."""
        fine: NDArray[np.bool_] = self.field.slack(poses) >= margin
        if len(self.obstacles):
            fine &= self.distance(poses) >= self.clearance
        return fine

    def admits(self, way: NDArray[Any], margin: float) -> bool:
        """Whether a way (M, 3) that the robot is about to drive keeps both constraints.

        Where the robot already has less room than it should, it must keep what it has.
        """
        slack = self.field.slack(way)
        if slack.min() < min(margin, float(slack[0]) - 0.005):
            return False
        distance = self.distance(way)
        return bool(distance.min() >= min(self.clearance, float(distance[0]) - 0.005))


def arc(pose: Pose2, forward: float, turn: float, seconds: float) -> Array:
    """(4, 3) poses from a pose on, under constant speeds (m/s, rad/s)."""
    times = np.linspace(0.0, seconds, 4)
    turned = turn * times
    chord = forward * times * np.sinc(0.5 * turned / math.pi)
    middle = pose.heading + 0.5 * turned
    return np.column_stack(
        [pose.x + chord * np.cos(middle), pose.y + chord * np.sin(middle), pose.heading + turned]
    )
