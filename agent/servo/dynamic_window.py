"""Which way to steer now: the best of a fan of short arcs that touch nothing (dynamic window).

Fox, Burgard and Thrun, "The dynamic window approach to collision avoidance", 1997; here the arcs need not be
tried against accelerations, as the robot is slow and its stopping distance is counted by the guard.
"""

import math

import numpy as np

from mapweave.agent.observation import Command, RobotDescription
from mapweave.hybridmap.pose import Array

HORIZON = 0.8
"""An arc is simulated for this long, s."""
MARGIN = 0.055
"""Room that an arc leaves between the footprint and anything seen, m; more than the guard's, or that would
stop what is chosen here."""
WISHED = 0.12
"""Room above which more is worth nothing, m."""
SPEEDS = (1.0, 0.6, 0.3, 0.0, -0.3)
"""Shares of the wanted speed that are tried; negative ones drive back."""
TURNS = (1.0, 0.7, 0.45, 0.25, 0.1)
"""Shares of the largest rate that are tried, to either side."""
FACING = 0.25
"""What it is worth to face the way, m/rad."""
ROOM = 0.05
"""What it costs to have no room at all beyond the margin, m."""
BACKWARD = 0.08
"""What it costs to drive back, m: the rangers see as well there, the camera does not."""


class DynamicWindow:
    """The fan of arcs of one robot."""

    def __init__(self, description: RobotDescription) -> None:
        """Prepare for a robot's footprint."""
        self._radius = description.radius

    def toward(self, ahead: Array, points: Array, speed: float, rate: float) -> Command:
        """The best command toward a point.

        Args:
            ahead: (2,) m in robot, where to.
            points: (N, 2) m in robot, what must not be touched.
            speed: m/s, wanted.
            rate: rad/s, largest.
        """
        error, distance = math.atan2(ahead[1], ahead[0]), float(np.hypot(*ahead))
        # In addition to the fan, the turn that ends facing the point.
        exact = float(np.clip(error / HORIZON, -rate, rate))
        turns = rate * np.concatenate([TURNS, [0.0], -np.array(TURNS)])
        fan_turns = np.append(turns, exact)
        forward, turn = (
            grid.ravel() for grid in np.meshgrid(speed * np.array(SPEEDS), fan_turns, indexing="ij")
        )
        moving = (np.abs(forward) > 1e-6) | (np.abs(turn) > 0.02 * rate)
        forward, turn = forward[moving], turn[moving]
        ends, room = self._driven(forward, turn, points)
        to_go = ahead - ends[:, :2]
        off = np.abs(_wrapped(np.arctan2(to_go[:, 1], to_go[:, 0]) - ends[:, 2]))
        left = np.hypot(*to_go.T)
        cost = left + FACING * np.minimum(1.0, distance / 0.2) * off
        cost += ROOM * np.clip(1.0 - (room - MARGIN) / (WISHED - MARGIN), 0.0, 1.0)
        cost += np.where(forward < 0.0, BACKWARD, 0.0)
        now = np.hypot(*points.T).min() - self._radius if len(points) else math.inf
        free = (room >= min(MARGIN, now) - 1e-9) | (forward == 0.0)
        best = int(np.where(free, cost, np.inf).argmin())
        return Command(float(forward[best]), float(turn[best]))

    def _driven(self, forward: Array, turn: Array, points: Array) -> tuple[Array, Array]:
        """Where arcs end, (A, 3) m, m, rad in robot, and the least room along each, (A,) m."""
        time = np.linspace(0.0, HORIZON, 9)[1:]
        angle = turn[:, None] * time
        chord = forward[:, None] * time * np.sinc(0.5 * angle / math.pi)
        x, y = chord * np.cos(0.5 * angle), chord * np.sin(0.5 * angle)
        ends = np.stack([x[:, -1], y[:, -1], angle[:, -1]], axis=1)
        if not len(points):
            return ends, np.full(len(forward), math.inf)
        near = points[np.hypot(*points.T) < self._radius + 0.6]
        if not len(near):
            return ends, np.full(len(forward), math.inf)
        squared = (x[..., None] - near[:, 0]) ** 2 + (y[..., None] - near[:, 1]) ** 2
        return ends, np.sqrt(squared.min(axis=(1, 2))) - self._radius


def _wrapped(angles: Array) -> Array:
    return np.asarray(np.mod(angles + math.pi, 2.0 * math.pi) - math.pi)
