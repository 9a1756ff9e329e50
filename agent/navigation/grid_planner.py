"""Paths over a local grid with clearance: short where there is room, in the middle where it is narrow."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.jit import Cube, Matrix, compiled_form_of
from mapweave.hybridmap.pose import Array

_STEPS = np.array([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy])
_LENGTHS = np.hypot(*_STEPS.T)


def _spread_in_numpy(tolls: Cube, costs: Matrix) -> None:
    """See _spread: all cells at once, in as many sweeps as the longest way has cells."""
    _, rows, columns = tolls.shape
    inner = costs[1:-1, 1:-1]
    origins = [costs[1 + dx : rows + 1 + dx, 1 + dy : columns + 1 + dy] for dx, dy in _STEPS.tolist()]
    while True:
        before = inner.copy()
        for neighbour_costs, toll in zip(origins, tolls, strict=True):
            np.minimum(inner, neighbour_costs + toll, out=inner)
        if np.array_equal(before, inner):
            return


@compiled_form_of(_spread_in_numpy)
def _spread(tolls: Cube, costs: Matrix) -> None:
    """Lower costs until none can be lowered: that of a cell is the least of a neighbour's and its toll.

    Cell by cell, to and fro, which takes a few passes. Each way is summed up from its beginning, so both
    forms give the same costs to the last bit.

    Args:
        tolls: (8, R, C) to enter each cell from each neighbour, in the order of _STEPS.
        costs: (R + 2, C + 2) with a border of infinite ones; changed in place.
    """
    _, rows, columns = tolls.shape
    lowered = True
    while lowered:
        lowered = False
        for turn in range(4):
            for k in range(rows):
                row = k if turn < 2 else rows - 1 - k
                for m in range(columns):
                    column = m if turn % 2 == 0 else columns - 1 - m
                    least, step = costs[row + 1, column + 1], 0
                    for dx in range(3):
                        for dy in range(3):
                            if dx != 1 or dy != 1:
                                least = min(least, costs[row + dx, column + dy] + tolls[step, row, column])
                                step += 1
                    if least < costs[row + 1, column + 1]:
                        costs[row + 1, column + 1] = least
                        lowered = True


class GridPlanner:
    """The cheapest ways from one cell to all others.

    A cell costs its width, and up to four times that where the clearance is less than wished. A cell with
    less clearance than the least may only be entered from one with less still: so the robot can leave a place
    that is too tight.

    Attributes:
        costs: (R, C) in cells; infinite where there is no way.
    """

    def __init__(self, room: Array, first: tuple[int, int], least: float, wished: float) -> None:
        """Compute them.

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
        self.costs = costs[1:-1, 1:-1]
        tolls = np.empty((len(_STEPS), rows, columns))
        for toll, (dx, dy), length in zip(tolls, _STEPS.tolist(), _LENGTHS, strict=True):
            origin = (slice(1 + dx, rows + 1 + dx), slice(1 + dy, columns + 1 + dy))
            toll[:] = np.where(self._may(padded[origin], room), length * self._price, np.inf)
        _spread(tolls, costs)

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
