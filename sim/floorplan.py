"""The floor plan: walls and furniture, for clearance queries and for drawing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.limits import Coordinate, Words
from mapweave.hybridmap.pose import Array, Pose2

CELL = 0.05
"""Grid step of the free-space search, m."""
REACH = 2.0
"""Clearances on the grid are measured up to here, m: a wall is compared with the cells around it alone."""

Box = tuple[float, float, float, float]
"""(x0, y0, x1, y1) m, in world, upright."""


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A rotated rectangle on the floor.

    Attributes:
        x: of the centre, m, in world.
        y: of the centre, m, in world.
        length: along its own x axis, m.
        width: along its own y axis, m.
        heading: of its x axis, rad.
        name: of the thing.
    """

    x: Coordinate
    y: Coordinate
    length: Coordinate
    width: Coordinate
    heading: Coordinate = 0.0
    name: Words = ""

    @property
    def corners(self) -> Array:
        """(4, 2) m, in world, counter-clockwise."""
        a, b = self.length / 2, self.width / 2
        return Pose2(self.x, self.y, self.heading).apply(np.array([[-a, -b], [a, -b], [a, b], [-a, b]]))

    @staticmethod
    def spanning(x0: float, y0: float, x1: float, y1: float, name: str = "") -> Rectangle:
        """The upright rectangle between two corners."""
        return Rectangle((x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0, 0.0, name)


def distances_to(rectangles: Iterable[Rectangle], points: NDArray[Any]) -> Array:
    """Distance of points to the nearest rectangle, (N,) m; zero inside, infinite without rectangles.

    Args:
        rectangles: any number.
        points: (N, 2) m, in world.
    """
    points = np.asarray(points, dtype=np.float64)
    nearest: Array = np.full(len(points), np.inf)
    for box in rectangles:
        np.minimum(nearest, _distances(box, points[:, 0], points[:, 1]), out=nearest)
    return nearest


def _distances(box: Rectangle, x: Array, y: Array) -> Array:
    """Distance of points to a rectangle, m, zero inside; x and y, m, in world, of shapes that broadcast."""
    if box.heading == 0.0:
        along, across = x - box.x, y - box.y
    else:
        there = Pose2(box.x, box.y, box.heading).inverse()
        c, s = math.cos(there.heading), math.sin(there.heading)
        along, across = there.x + c * x - s * y, there.y + s * x + c * y
    outside = np.maximum(np.abs(along) - box.length / 2, 0.0), np.maximum(np.abs(across) - box.width / 2, 0.0)
    distances: Array = np.hypot(*outside)
    return distances


@dataclass(frozen=True)
class BuildingPlan:
    """A building seen from above.

    Attributes:
        rooms: where one may be: rooms, corridors and door openings, with names; they touch one another.
        walls: solid, floor to ceiling.
        furniture: solid.
    """

    rooms: tuple[Rectangle, ...]
    walls: tuple[Rectangle, ...]
    furniture: tuple[Rectangle, ...] = ()

    @property
    def bounds(self) -> Box:
        """(x0, y0, x1, y1) m, in world, around everything."""
        corners = np.concatenate([r.corners for r in (*self.rooms, *self.walls)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def clearances(self, points: NDArray[Any]) -> Array:
        """Distance of points to the nearest wall or furniture, (N,) m; zero outside the building.

        Args:
            points: (N, 2) m, in world.
        """
        clearances = distances_to((*self.walls, *self.furniture), points)
        clearances[distances_to(self.rooms, points) > 1e-9] = 0.0
        return clearances

    def is_free(self, x: float, y: float, radius: float) -> bool:
        """Whether a disc of this radius fits there."""
        return bool(self.clearances(np.array([[x, y]]))[0] >= radius)

    def room_at(self, x: float, y: float) -> str | None:
        """Name of the room that a point lies in, or None outside."""
        for room in self.rooms:
            if distances_to([room], np.array([[x, y]]))[0] <= 1e-9:
                return room.name
        return None

    def room(self, name: str) -> Rectangle:
        """The room of this name.

        Raises:
            InvalidValue: there is none.
        """
        for room in self.rooms:
            if room.name == name:
                return room
        raise InvalidValue(f"no room {name!r}; there are {', '.join(r.name for r in self.rooms)}")

    @cached_property
    def grid(self) -> Grid:
        """The clearances of the whole building."""
        return Grid.of(self.rooms, (*self.walls, *self.furniture), self.bounds, self.bounds)

    def free_regions(self, radius: float) -> list[Array]:
        """Connected sets of points where a disc fits, each (N, 2) m, in world, largest set first.

        Two points of one set are joined by a path along which the disc fits (to the 5 cm of the grid).
        """
        grid = self.grid
        free = grid.clearances >= radius
        if radius > REACH:
            free = self.clearances(grid.centres.reshape(-1, 2)).reshape(free.shape) >= radius
        count, labels = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
        regions = [grid.centres[labels == label] for label in range(1, count)]
        return sorted(regions, key=len, reverse=True)

    def free_points(self, radius: float, room: str | None = None) -> Array:
        """(N, 2) m, in world: grid points of the largest region where a disc of this radius fits.

        Args:
            radius: of the disc, m.
            room: name of a room; then the largest of the parts of one region that lie in it.

        Raises:
            InvalidValue: no such room.
        """
        regions = self.free_regions(radius)
        if room is not None:
            return largest_part(regions, self.room(room))
        return regions[0] if regions else np.zeros((0, 2))

    def random_free_pose(self, rng: np.random.Generator, radius: float, room: str | None = None) -> Pose2:
        """A reachable pose with any heading, in any room or the given one.

        Args:
            rng: random numbers.
            radius: what must fit there and along the way there, m.
            room: name of a room.

        Raises:
            InvalidValue: no such room, or nothing that large fits there.
        """
        points = self.free_points(radius, room)
        if len(points) == 0:
            raise InvalidValue(f"a disc of {radius} m fits nowhere in {room or 'the building'}")
        return random_pose(rng, points)


def largest_part(regions: Sequence[Array], room: Rectangle) -> Array:
    """(N, 2) m, in world: the largest part of a region in a room; `random_pose` does not leave it."""
    inner = replace(room, length=max(room.length - CELL / 2, 0.0), width=max(room.width - CELL / 2, 0.0))
    parts = (region[distances_to([inner], region) <= 1e-9] for region in regions)
    return max(parts, key=len, default=np.zeros((0, 2)))


def random_pose(rng: np.random.Generator, points: NDArray[Any]) -> Pose2:
    """One of (N, 2) grid points in world, off by less than half a cell, with any heading."""
    x, y = points[rng.integers(len(points))] + rng.uniform(-CELL / 4, CELL / 4, 2)
    return Pose2(float(x), float(y), float(rng.uniform(-math.pi, math.pi)))


@dataclass(frozen=True, eq=False)
class Grid:
    """Clearances at points 5 cm apart.

    Attributes:
        centres: (rows, columns, 2) m, in world.
        clearances: (rows, columns) m to the nearest wall or furniture, at most `REACH`; zero outside.
    """

    centres: Array
    clearances: Array

    @staticmethod
    def of(rooms: Iterable[Rectangle], solids: Iterable[Rectangle], bounds: Box, window: Box) -> Grid:
        """The part of a building's grid that lies in a window.

        Args:
            rooms: where one may be.
            solids: walls and furniture, at least all within `REACH` of the window.
            bounds: of the whole building; its grid is the same whatever the window.
            window: what is measured.
        """
        x0, y0, x1, y1 = bounds
        xs, ys = np.arange(x0 + CELL / 2, x1, CELL), np.arange(y0 + CELL / 2, y1, CELL)
        xs, ys = xs[(xs >= window[0]) & (xs <= window[2])], ys[(ys >= window[1]) & (ys <= window[3])]
        centres: Array = np.stack(np.meshgrid(xs, ys), axis=-1)
        inside = np.zeros(centres.shape[:2], bool)
        for room in rooms:
            rows, columns = _around(centres, room, 0.0)
            inside[rows, columns] |= _distances(room, xs[None, columns], ys[rows, None]) <= 1e-9
        grid = Grid(centres, np.where(inside, REACH, 0.0))
        for box in solids:
            grid.add(box)
        return grid

    def with_box(self, box: Rectangle) -> Grid:
        """The same grid with one more solid thing."""
        grid = Grid(self.centres, self.clearances.copy())
        grid.add(box)
        return grid

    def add(self, box: Rectangle) -> None:
        """One more solid thing, in place."""
        rows, columns = _around(self.centres, box, REACH)
        xs, ys = self.centres[:1, columns, 0], self.centres[rows, :1, 1]
        clearances = self.clearances[rows, columns]
        np.minimum(clearances, _distances(box, xs, ys), out=clearances)


def _around(centres: Array, box: Rectangle, margin: float) -> tuple[slice, slice]:
    """Rows and columns of the cells that lie within a margin of an upright box around a rectangle."""
    if centres.size == 0:
        return slice(0, 0), slice(0, 0)
    corners = box.corners
    low, high = corners.min(axis=0) - margin - 1e-9, corners.max(axis=0) + margin + 1e-9
    xs, ys = centres[0, :, 0], centres[:, 0, 1]
    columns = slice(int(np.searchsorted(xs, low[0])), int(np.searchsorted(xs, high[0], "right")))
    rows = slice(int(np.searchsorted(ys, low[1])), int(np.searchsorted(ys, high[1], "right")))
    return rows, columns
