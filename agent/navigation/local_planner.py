"""Driving to a position between nodes: around what the rangers have seen on the way."""

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.servo.dynamic_window import DynamicWindow
from mapweave.agent.servo.proximity import ranger_points
from mapweave.agent.settings import NavigatorSettings, OccupancyGridSettings
from mapweave.hybridmap.pose import Array, Pose2

_STEPS = np.array([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy])
_LENGTHS = np.hypot(*_STEPS.T)


def _least_costs(tolls: Array, first: tuple[int, int], goal: tuple[int, int] | None) -> Array:
    """(R, C) cost of the cheapest way to each cell, by Dijkstra's search; infinite where there is none.

    Plain Python: each cell waits for its neighbours, so there is nothing that NumPy could do for many at once
    (docs/decisions/kernels.md).

    Args:
        tolls: (8, R, C) to enter each cell from each neighbour, in the order of _STEPS.
        first: row and column where the ways begin.
        goal: where the search ends: cells that cost more are left out. None searches to the end.
    """
    _, rows, columns = tolls.shape
    # A border that cannot be entered saves the question whether a neighbour is inside.
    fenced = np.pad(tolls, ((0, 0), (1, 1), (1, 1)), constant_values=np.inf).reshape(len(tolls), -1)
    width = columns + 2
    moves = [
        (-dx * width - dy, toll) for (dx, dy), toll in zip(_STEPS.tolist(), fenced.tolist(), strict=True)
    ]
    costs = [math.inf] * ((rows + 2) * width)
    start = (first[0] + 1) * width + first[1] + 1
    end = None if goal is None else (goal[0] + 1) * width + goal[1] + 1
    costs[start], queue = 0.0, [(0.0, start)]
    while queue:
        cost, at = heapq.heappop(queue)
        if at == end:
            break
        if cost > costs[at]:
            continue
        for move, toll in moves:
            there = at + move
            total = cost + toll[there]
            if total < costs[there]:
                costs[there] = total
                heapq.heappush(queue, (total, there))
    return np.array(costs).reshape(rows + 2, width)[1:-1, 1:-1]


class GridPlanner:
    """The cheapest ways from one cell to all others.

    A cell costs its width, and up to four times that where the clearance is less than wished. A cell with
    less clearance than the least may only be entered from one with less still: so the robot can leave a place
    that is too tight.

    Attributes:
        costs: (R, C) in cells; infinite where there is no way. Of cells further than the goal, if one is
            given and can be reached, infinite or too large.
    """

    def __init__(
        self,
        room: Array,
        first: tuple[int, int],
        least: float,
        wished: float,
        goal: tuple[int, int] | None = None,
    ) -> None:
        """Compute them.

        Args:
            room: (R, C) m, distance of each cell from the nearest thing.
            first: row and column.
            least: m, clearance that a way needs.
            wished: m, clearance above which more has no value.
            goal: the only one that `way_to` will be asked for; it saves most of the search if it is near.
        """
        self._room, self._least = room, least
        lack = np.clip((wished - room) / (wished - least), 0.0, 1.0)
        self._price = 1.0 + 3.0 * lack * lack
        rows, columns = room.shape
        padded = np.pad(room, 1, constant_values=-math.inf)
        tolls = np.empty((len(_STEPS), rows, columns))
        for toll, (dx, dy), length in zip(tolls, _STEPS.tolist(), _LENGTHS, strict=True):
            origin = (slice(1 + dx, rows + 1 + dx), slice(1 + dy, columns + 1 + dy))
            toll[:] = np.where(self._may(padded[origin], room), length * self._price, np.inf)
        near = goal if goal is not None and room[goal] >= least else None
        self.costs = _least_costs(tolls, first, near)

    def way_to(self, goal: tuple[int, int]) -> NDArray[np.int64]:
        """(N, 2) cells from the first one to a goal (row and column), or to the cell nearest to it.

        Of the cells that there is a way to, those with room enough come first.
        """
        reached = np.isfinite(self.costs)
        ends = reached & (self._room >= self._least)
        cells = np.argwhere(ends if ends.any() else reached)
        at = cells[np.hypot(*(cells - goal).T).argmin()]
        way = [at]
        while self.costs[tuple(at)] > 0.0:
            around = at + _STEPS
            inside = (around >= 0).all(axis=1) & (around < self.costs.shape).all(axis=1)
            around, lengths = around[inside], _LENGTHS[inside]
            neighbours = tuple(around.T)
            totals = self.costs[neighbours] + lengths * self._price[tuple(at)]
            at = around[
                np.where(self._may(self._room[neighbours], self._room[tuple(at)]), totals, np.inf).argmin()
            ]
            way.append(at)
        return np.array(way[::-1])

    def _may(self, before: Array, after: Array) -> NDArray[np.bool_]:
        """Whether the robot may go from cells with some room (m) to cells with other room (m)."""
        return np.asarray((after >= self._least) | ((before < self._least) & (after > before)))


AROUND = OccupancyGridSettings(cell=0.05, side=6.4)
"""The grid that moves along with the robot, which stands in its middle."""
REPLAN_EVERY = 5
"""Ticks between two plans."""
LEAST = 0.065
"""Clearance around the footprint that a way needs, m."""
WISHED = 0.2
"""Clearance above which more has no value, m."""
AHEAD = 0.6
"""Largest distance of the point of the way that it steers to, m."""


class LocalPlanner:
    """Keeps a local occupancy grid in the odometry frame.

    That frame drifts, but the grid is needed for a few metres only.
    """

    def __init__(self, description: RobotDescription, settings: NavigatorSettings | None = None) -> None:
        """Start with an unknown grid."""
        self._settings = settings or NavigatorSettings()
        self._description = description
        self._floor = OccupancyGrid(description, AROUND)
        self._arcs = DynamicWindow(description)
        self._odom_from_robot = Pose2()
        self._way: Array = np.zeros((0, 2))
        self._points: Array = np.zeros((0, 2))
        self._tick = 0
        self._replan_at = 0

    @property
    def around(self) -> bool:
        """Whether the way leads around something."""
        return bool(len(self._way))

    def see(self, observation: Observation) -> None:
        """Take in what the robot senses, every tick."""
        self._tick += 1
        self._odom_from_robot = odom_from_robot = self._odom_from_robot @ observation.odometry.motion()
        self._floor.roll(np.array([odom_from_robot.x, odom_from_robot.y]))
        self._floor.see(odom_from_robot, observation.proximity)
        self._points = ranger_points(observation.proximity, self._description)

    def toward(self, robot_from_target: Pose2) -> Command:
        """Turn toward a position, then drive to it.

        Args:
            robot_from_target: where it is; its heading does not matter.
        """
        s, odom_from_robot = self._settings, self._odom_from_robot
        start = np.array([odom_from_robot.x, odom_from_robot.y])
        goal = odom_from_robot.apply(np.array([robot_from_target.x, robot_from_target.y]))
        if self._tick >= self._replan_at:
            self._replan_at = self._tick + REPLAN_EVERY
            self._way = self._plan(start, goal)
        ahead = odom_from_robot.inverse().apply(self._steered_to(start, goal))
        speed = min(s.speed, 0.8 * float(np.hypot(*ahead)))
        return self._arcs.toward(ahead, self._points, speed, s.turn_rate)

    def _plan(self, start: Array, goal: Array) -> Array:
        """(N, 2) m in odom, points of the way around; none if the straight way is free."""
        room = self._floor.room()
        least, wished = (self._description.radius + extra for extra in (LEAST, WISHED))
        # The robot is in the middle of the grid; beyond its border everything is unknown.
        goal = start + (goal - start) * min(1.0, 0.5 * AROUND.side / max(np.abs(goal - start).max(), 1e-9))
        count = int(np.hypot(*(goal - start)) / (0.5 * AROUND.cell)) + 2
        line = self._floor.cells(start + np.linspace(0.0, 1.0, count)[:, None] * (goal - start))
        if (room[line[:, 0], line[:, 1]] >= 0.5 * (least + wished)).all():
            return np.zeros((0, 2))
        first, last = self._floor.cells(np.stack([start, goal]))
        here, there = (int(first[0]), int(first[1])), (int(last[0]), int(last[1]))
        cells = GridPlanner(room, here, least, wished, there).way_to(there)
        return np.array([self._floor.centre((int(a), int(b))) for a, b in cells[1:]]).reshape(-1, 2)

    def _steered_to(self, start: Array, goal: Array) -> Array:
        """(2,) m in odom: the furthest point of the way up to which a straight line stays near the way."""
        if not len(self._way):
            return goal
        nearest = int(np.hypot(*(self._way - start).T).argmin())
        offsets = self._way[nearest:] - start
        chosen = 0
        for k in range(1, len(offsets)):
            length = math.hypot(*offsets[k])
            if length > AHEAD:
                break
            aside = offsets[:k] @ np.array([-offsets[k, 1], offsets[k, 0]]) / max(length, 1e-9)
            if np.abs(aside).max() > AROUND.cell:
                break
            chosen = k
        return np.asarray(start + offsets[chosen])
