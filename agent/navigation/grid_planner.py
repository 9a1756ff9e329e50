"""Paths over a local grid with clearance: short where there is room, in the middle where it is narrow."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array

_STEPS = np.array([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy])
_LENGTHS = np.hypot(*_STEPS.T)


class GridPlanner:
    """The cheapest ways from one cell to all others.

    A cell costs its width, and up to four times that where the clearance is less than wished. A cell with
    less clearance than the least may only be entered from one with less still: so the robot can leave a place
    that is too tight.

    Attributes:
        costs: (R, C) in cells; infinite where there is no way.
    """

    def __init__(self, room: Array, first: tuple[int, int], least: float, wished: float) -> None:
        """Compute them, all cells at once, in as many sweeps as the longest way has cells.

        Args:
            room: (R, C) m, distance of each cell from the nearest thing.
            first: row and column.
            least: m, clearance that a way needs.
            wished: m, clearance above which more has no value.
        """
        self._room, self._least = room, least
        lack = np.clip((wished - room) / (wished - least), 0.0, 1.0)
        self._price = 1.0 + 3.0 * lack * lack
        rows, columns = room.shape
        padded = np.pad(room, 1, constant_values=-math.inf)
        costs = np.full(padded.shape, np.inf)
        costs[first[0] + 1, first[1] + 1] = 0.0
        self.costs = inner = costs[1:-1, 1:-1]
        entering = []
        for (dx, dy), length in zip(_STEPS.tolist(), _LENGTHS, strict=True):
            origin = (slice(1 + dx, rows + 1 + dx), slice(1 + dy, columns + 1 + dy))
            may = self._may(padded[origin], room)
            entering.append((costs[origin], np.where(may, length * self._price, np.inf)))
        while True:
            before = inner.copy()
            for neighbour_costs, toll in entering:
                np.minimum(inner, neighbour_costs + toll, out=inner)
            if np.array_equal(before, inner):
                return

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
