"""Occupancy grid of the proximity sensors: where the robot may drive, and what is unknown."""

from __future__ import annotations

import heapq
import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import RobotDescription
from mapweave.agent.settings import OccupancyGridSettings
from mapweave.hybridmap.pose import Array, Pose2

HIT = 0.9
"""Log-odds that a cell gains when a ranger ends in it."""
MISS = 0.35
"""Log-odds that a cell loses when a ranger passes through it."""
MOST = 3.0
"""Log-odds are kept within plus and minus this, so that a thing that moved away is forgotten."""


DECIDED = 0.3
"""Log-odds beyond which a cell counts as occupied, or free."""
RAYS = 48
"""Rays of a full turn."""


FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Cells, as in nav_msgs/msg/OccupancyGrid."""


class GridCells(NamedTuple):
    """An occupancy grid as it was at one time.

    Attributes:
        odds: (N, N) log-odds that a cell is occupied; rows along x, columns along y of the map.
        decided: a cell is occupied above this, and free below its negative.
        corner: (2,) m in map, where the first cell begins.
        side: of a cell, m.
    """

    odds: NDArray[np.float32]
    decided: float
    corner: Array
    side: float

    @property
    def occupancy(self) -> NDArray[np.int8]:
        """(N, N) OCCUPIED, FREE or UNKNOWN."""
        free_or_not = np.where(self.odds < -self.decided, FREE, UNKNOWN)
        cells = np.where(self.odds > self.decided, OCCUPIED, free_or_not)
        return cells.astype(np.int8)


class OccupancyGrid:
    """A grid of log-odds that a cell is occupied; 0 is unknown."""

    def __init__(self, description: RobotDescription, settings: OccupancyGridSettings | None = None) -> None:
        """Start with everything unknown."""
        self._settings = settings or OccupancyGridSettings()
        self._description = description
        self._half = round(self._settings.side / 2 / self._settings.cell)
        self._middle = np.zeros(2, np.int64)
        self._odds: NDArray[np.float32] = np.zeros((2 * self._half, 2 * self._half), np.float32)
        self._bearings = np.array(description.ranger_bearings)
        self._steps = np.arange(0.5, description.ranger_reach / self._settings.cell) * self._settings.cell

    def taken(self) -> GridCells:
        """The grid as it is now; it does not change any more."""
        side = self._settings.cell
        corner = np.asarray((self._middle - self._half) * side, np.float64)
        return GridCells(self._odds.copy(), DECIDED, corner, side)

    def cells(self, points: Array) -> NDArray[np.int64]:
        """(..., 2) m in map -> (..., 2) cell indices, clipped to the grid."""
        index = np.floor(points / self._settings.cell).astype(np.int64) + self._half - self._middle
        return np.asarray(np.minimum(np.maximum(index, 0), 2 * self._half - 1), np.int64)

    def centre(self, cell: tuple[int, int]) -> Array:
        """(2,) m in map, middle of a cell."""
        return self.centres(np.array(cell))

    def centres(self, cells: NDArray[np.int64]) -> Array:
        """(..., 2) cell indices -> (..., 2) m in map, their middles."""
        return (cells.astype(np.float64) - self._half + self._middle + 0.5) * self._settings.cell

    def roll(self, point: Array) -> None:
        """Let the grid's middle be at a point, (2,) m in map; what falls over its border is forgotten."""
        middle = np.round(np.asarray(point) / self._settings.cell).astype(np.int64)
        rows, columns = (int(v) for v in middle - self._middle)
        self._middle = middle
        kept = np.zeros_like(self._odds)
        size = len(kept)
        if abs(rows) < size and abs(columns) < size:
            into = slice(max(-rows, 0), size - max(rows, 0)), slice(max(-columns, 0), size - max(columns, 0))
            from_ = slice(max(rows, 0), size - max(-rows, 0)), slice(max(columns, 0), size - max(-columns, 0))
            kept[into] = self._odds[from_]
        self._odds = kept

    def see(self, map_from_robot: Pose2, proximity: Array) -> None:
        """Enter what the rangers measure: free along the beam, occupied at its end.

        Args:
            map_from_robot: pose.
            proximity: (K,) m from the robot's edge.
        """
        if len(proximity) != len(self._bearings) or not len(proximity):
            return
        s, radius = self._settings, self._description.radius
        angles = map_from_robot.heading + self._bearings
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        origin = np.array([map_from_robot.x, map_from_robot.y])
        ends = proximity + radius
        along = self._steps[None, :] < (ends - 0.5 * s.cell)[:, None]
        points = origin + directions[:, None, :] * self._steps[None, :, None]
        hits = proximity < self._description.ranger_reach - 0.05
        # A cell counts once, however many beams meet it: all of them write the same into it.
        ended = origin + directions[hits] * ends[hits, None]
        odds, passing = self._odds.reshape(-1), points[along]
        numbers = self._numbers(np.concatenate([passing, ended, origin + _FOOTPRINT]))
        first, last = len(passing), len(passing) + len(ended)
        odds[numbers[:first]] -= MISS
        odds[numbers[first:last]] += HIT + MISS
        # The robot's own footprint is free.
        odds[numbers[last:]] = -MOST
        odds[numbers] = np.minimum(np.maximum(odds[numbers], -MOST), MOST)

    def _numbers(self, points: Array) -> NDArray[np.int64]:
        """(N,) numbers of the cells, row by row, in which (N, 2) m in map lie."""
        cells = self.cells(points)
        return np.asarray(cells[:, 0] * self._odds.shape[1] + cells[:, 1], np.int64)

    def room(self) -> Array:
        """The distance from each cell to the nearest thing seen, m."""
        occupied = (self._odds > DECIDED).astype(np.uint8)
        return np.asarray(cv2.distanceTransform(1 - occupied, cv2.DIST_L2, 5) * self._settings.cell)

    def drivable(self, unknown: bool = False) -> NDArray[np.bool_]:
        """Cells that are known to be free, with clearance for the footprint; or that may be free."""
        free = self._odds < (DECIDED if unknown else -DECIDED)
        return np.asarray(free & (self.room() >= self._enough))

    @property
    def _enough(self) -> float:
        return self._description.radius + self._settings.clearance

    def unknown_in_sight(self, points: Array, covered: Array, radius: float, reach: float) -> Array:
        """How much unknown floor would be seen from each of some points, by a full turn, (N,) m^2.

        Occupied cells hide what is behind them, and so do gaps between them that are too narrow for the
        robot: most of these are errors of its pose. Unknown cells hide nothing.

        Args:
            points: (N, 2) m in map.
            covered: (M, 2) m in map; others know the floor around these.
            radius: of that floor, m.
            reach: how far one can see, m.
        """
        return self._in_sight(points, self._unknown(covered, radius), reach)

    def distant_in_sight(self, points: Array, viewpoints: Array, reach: float) -> Array:
        """How much known floor each of some points shows from near that no viewpoint shows so, (N,) m^2.

        Args:
            points: (N, 2) m in map.
            viewpoints: (M, 2) m in map.
            reach: what is within this, with nothing between, is near, m.
        """
        distant = (self._odds < -DECIDED).astype(np.float32)
        # At most half a cell apart: every cell is met.
        rays = self._rays(reach, math.ceil(2.0 * math.tau * reach / self._settings.cell))
        hidden = self._closed()
        for viewpoint in viewpoints:
            at, visible = self._sight(viewpoint, rays, hidden)
            distant[at[visible, 0], at[visible, 1]] = 0.0
        return self._in_sight(points, distant, reach)

    def _in_sight(self, points: Array, wanted: NDArray[np.float32], reach: float) -> Array:
        """Area of the cells that are wanted, 1 or 0 each, in sight of each of (N, 2) m in map, (N,) m^2."""
        rays, hidden = self._rays(reach, RAYS), self._closed()
        pieces = np.linalg.norm(rays[0], axis=1) * self._settings.cell * (math.tau / RAYS)
        areas = np.zeros(len(points))
        for k, point in enumerate(points):
            at, visible = self._sight(point, rays, hidden)
            areas[k] = (wanted[at[..., 0], at[..., 1]] * visible * pieces).sum()
        return areas

    def _rays(self, reach: float, count: int) -> Array:
        """(count, S, 2) m: points along rays in all directions, a cell apart, from where they begin."""
        angles = np.arange(count) * (math.tau / count)
        along = np.arange(0.5 * self._settings.cell, reach, self._settings.cell)
        return np.asarray(along[None, :, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None])

    def _sight(
        self, point: Array, rays: Array, hidden: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The cells along rays from a point, (2,) m in map, and which of them nothing hides."""
        at = self.cells(point + rays)
        return at, ~np.logical_or.accumulate(hidden[at[..., 0], at[..., 1]], axis=1)

    def _closed(self) -> NDArray[np.bool_]:
        """Occupied cells, and gaps between them through which the robot does not fit.

        One cell thicker than they are, so that no ray gets through between two that meet at a corner.
        """
        occupied, cells = (self._odds > DECIDED).astype(np.uint8), round(self._enough / self._settings.cell)
        return cv2.erode(cv2.dilate(occupied, _disc(cells + 1)), _disc(cells)) > 0

    def _unknown(self, covered: Array, radius: float) -> NDArray[np.float32]:
        """1 where a cell is unknown and none of (N, 2) points in map is within the radius (m), else 0."""
        unknown = (np.abs(self._odds) <= DECIDED).astype(np.float32)
        for row, column in self.cells(covered):
            cv2.circle(unknown, (int(column), int(row)), round(radius / self._settings.cell), 0.0, -1)
        return unknown

    def ways(self, start: Array, reach: float) -> DistanceField:
        """Shortest ways over drivable cells to everything within reach of a position.

        Args:
            start: (2,) m in map.
            reach: longest way, m.
        """
        drivable = self.drivable()
        # Numbers of cells in a grid with a border that is never entered: a search asks for one at a time.
        width = drivable.shape[1] + 2
        free = np.pad(drivable, 1).tobytes()
        room = np.pad(self.room().astype(np.float64), 1, constant_values=-1.0).reshape(-1).data
        steps = [(dx * width + dy, self._settings.cell * math.hypot(dx, dy)) for dx, dy in _NEIGHBOURS]
        row, column = (int(v) for v in self.cells(start))
        first = (row + 1) * width + column + 1
        cost: dict[int, float] = {first: 0.0}
        before: dict[int, int] = {}
        queue: list[tuple[float, int]] = [(0.0, first)]
        while queue:
            distance, cell = heapq.heappop(queue)
            if distance > cost[cell] or distance > reach:
                continue
            # Close to something already, the robot may still leave it, but come no closer.
            least = -1.0 if free[cell] else max(room[cell], _CLOSE)
            for step, length in steps:
                neighbour = cell + step
                if not free[neighbour] and (least < 0.0 or room[neighbour] < least):
                    continue
                further = distance + length
                if further < cost.get(neighbour, math.inf):
                    cost[neighbour] = further
                    before[neighbour] = cell
                    heapq.heappush(queue, (further, neighbour))
        return DistanceField(self, drivable, cost, before)


def _disc(radius: int) -> NDArray[np.uint8]:
    """Cells within a radius of a cell, which is in the middle."""
    side = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


_FOOTPRINT: Array = np.array([[0.0, 0.0], [0.1, 0.0], [-0.1, 0.0], [0.0, 0.1], [0.0, -0.1]])
"""m, in robot."""
_NEIGHBOURS = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy]
_CLOSE = float(np.float32(0.05))
"""What is nearer than this is touched, m; of the precision of `OccupancyGrid.room`."""


class DistanceField:
    """Shortest ways from one place."""

    def __init__(
        self,
        floor: OccupancyGrid,
        drivable: NDArray[np.bool_],
        cost: dict[int, float],
        before: dict[int, int],
    ) -> None:
        """Take the result of a search, by the numbers of cells in a grid with a border of one cell."""
        self._floor = floor
        self._drivable = drivable
        self._before = before
        self._width = drivable.shape[1] + 2
        numbers = np.fromiter(cost, np.int64, len(cost))
        cells = np.stack(np.divmod(numbers, self._width), axis=1) - 1
        free = drivable[cells[:, 0], cells[:, 1]]
        self.cells = cells[free]
        self.lengths = np.fromiter(cost.values(), np.float64, len(cost))[free]

    @property
    def positions(self) -> Array:
        """(N, 2) m in map of the cells that can be reached."""
        return self._floor.centres(self.cells)

    def path(self, cell: NDArray[np.int64]) -> list[Array]:
        """Corners of the way to a cell, without the start: straight pieces over drivable cells."""
        at = (int(cell[0]) + 1) * self._width + int(cell[1]) + 1
        numbers = [at]
        while at in self._before:
            at = self._before[at]
            numbers.append(at)
        chain = [(row - 1, column - 1) for row, column in (divmod(n, self._width) for n in reversed(numbers))]
        corners: list[Array] = []
        first = 0
        while first < len(chain) - 1:
            last = len(chain) - 1
            while last > first + 1 and not self._straight(chain[first], chain[last]):
                last -= 1
            corners.append(self._floor.centre(chain[last]))
            first = last
        return corners

    def _straight(self, a: tuple[int, int], b: tuple[int, int]) -> bool:
        count = 2 * max(abs(a[0] - b[0]), abs(a[1] - b[1])) + 1
        rows = np.round(np.linspace(a[0], b[0], count)).astype(int)
        columns = np.round(np.linspace(a[1], b[1], count)).astype(int)
        return bool(self._drivable[rows[1:], columns[1:]].all())
