"""The shortest way across a floor for a round robot: what a drive is compared with. Truth only."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan

AWAY = 0.25
"""A pose counts as standing on the free floor this near to one of its cells, m."""
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
"""Steps in rows and columns; with the ways back sixteen, so that a path is at most 3 % too long."""


@dataclass(frozen=True, eq=False)
class FreeFloor:
    """Where a round robot can stand, as a graph of cells.

    Attributes:
        cells: (N, 2) m, in world.
        steps: (N, N) m, sparse: ways between neighbouring cells.
    """

    cells: Array
    steps: coo_array

    @staticmethod
    def of(plan: BuildingPlan, radius: float) -> FreeFloor:
        """The free floor of a building.

        Args:
            plan: what stands where.
            radius: of the robot, m.
        """
        grid = plan.grid
        free = grid.clearances >= radius
        number = np.full(free.shape, -1)
        number[free] = np.arange(int(free.sum()))
        size = float(grid.centres[0, 1, 0] - grid.centres[0, 0, 0])
        begins, ends, lengths = [], [], []
        for rows, columns in NEIGHBOURS:
            first, second = _shifted(number, rows, columns)
            joined = (first >= 0) & (second >= 0)
            begins.append(first[joined])
            ends.append(second[joined])
            lengths.append(np.full(int(joined.sum()), size * math.hypot(rows, columns)))
        count = int(free.sum())
        steps = coo_array(
            (np.concatenate(lengths), (np.concatenate(begins), np.concatenate(ends))), shape=(count, count)
        )
        return FreeFloor(grid.centres[free], steps)

    def ways_from(self, place: Pose2) -> ShortestWays:
        """The shortest ways from a place to everywhere."""
        gaps = np.hypot(*(self.cells - [place.x, place.y]).T)
        nearest = int(gaps.argmin())
        reached = gaps[nearest] <= AWAY
        lengths = dijkstra(self.steps, directed=False, indices=nearest)
        return ShortestWays(self.cells, place, lengths if reached else np.full(len(self.cells), np.inf))


@dataclass(frozen=True, eq=False)
class ShortestWays:
    """Shortest ways from one place.

    Attributes:
        cells: (N, 2) m, in world.
        start: where they begin.
        lengths: (N,) m to each cell; infinite where no way leads.
    """

    cells: Array
    start: Pose2
    lengths: Array

    def to(self, goal: Pose2) -> float:
        """Length of the shortest way, m; infinite if there is none. Never less than the straight line."""
        gaps = np.hypot(*(self.cells - [goal.x, goal.y]).T)
        nearest = int(gaps.argmin())
        if gaps[nearest] > AWAY:
            return math.inf
        return max(float(self.lengths[nearest]), self.start.distance(goal))


def _shifted(number: NDArray[np.int64], rows: int, columns: int) -> tuple[NDArray[np.int64], ...]:
    """Every cell and the cell so many rows and columns further, flat; both on the grid."""
    height, width = number.shape
    left, right = max(-columns, 0), width - max(columns, 0)
    first = number[: height - rows, left:right]
    second = number[rows:, left + columns : right + columns]
    return first.ravel(), second.ravel()
