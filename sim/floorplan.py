"""The floor plan: what stands where, for clearance queries and for drawing."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import InvalidValue
from hybridmap.pose import Array, Pose2

CELL = 0.05
"""Grid step of the free-space search, m."""


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A rotated rectangle on the floor.

    Attributes:
        x: of the centre, m, in world.
        y: of the centre, m, in world.
        length: along its own x axis, m.
        width: along its own y axis, m.
        heading: of its x axis, rad.
        name: what it is.
    """

    x: float
    y: float
    length: float
    width: float
    heading: float = 0.0
    name: str = ""

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
        local = np.abs(Pose2(box.x, box.y, box.heading).inverse().apply(points))
        outside = np.maximum(local - [box.length / 2, box.width / 2], 0.0)
        np.minimum(nearest, np.hypot(outside[:, 0], outside[:, 1]), out=nearest)
    return nearest


@dataclass(frozen=True)
class FloorPlan:
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
    def bounds(self) -> tuple[float, float, float, float]:
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
    def _grid(self) -> tuple[Array, Array]:
        """Cell centres (rows, columns, 2) m, in world, and their clearances (rows, columns) m."""
        x0, y0, x1, y1 = self.bounds
        xs = np.arange(x0 + CELL / 2, x1, CELL)
        ys = np.arange(y0 + CELL / 2, y1, CELL)
        centres: Array = np.stack(np.meshgrid(xs, ys), axis=-1)
        return centres, self.clearances(centres.reshape(-1, 2)).reshape(centres.shape[:2])

    def furnished(self, piece: Rectangle) -> FloorPlan:
        """The same plan with one more piece of furniture; what was measured of the rest is kept."""
        plan = FloorPlan(self.rooms, self.walls, (*self.furniture, piece))
        centres, clearances = self._grid
        to_piece = distances_to([piece], centres.reshape(-1, 2)).reshape(clearances.shape)
        plan.__dict__["_grid"] = centres, np.minimum(clearances, to_piece)
        return plan

    def free_regions(self, radius: float) -> list[Array]:
        """Connected sets of points where a disc fits, each (N, 2) m, in world, largest set first.

        Two points of one set are joined by a path along which the disc fits (to the 5 cm of the grid).
        """
        centres, clearances = self._grid
        _, labels = cv2.connectedComponents((clearances >= radius).astype(np.uint8), connectivity=4)
        regions = [centres[labels == label] for label in range(1, int(labels.max()) + 1)]
        return sorted(regions, key=len, reverse=True)

    def free_points(self, radius: float) -> Array:
        """(N, 2) m, in world: grid points of the largest region where a disc of this radius fits."""
        regions = self.free_regions(radius)
        return regions[0] if regions else np.zeros((0, 2))

    def random_free_pose(self, rng: np.random.Generator, radius: float, room: str | None = None) -> Pose2:
        """A reachable pose with any heading, in any room or the given one.

        Args:
            rng: where chance comes from.
            radius: what must fit there and along the way there, m.
            room: name of a room.

        Raises:
            InvalidValue: no such room, or nothing that large fits there.
        """
        points = self.free_points(radius)
        if room is not None:
            points = points[distances_to([self.room(room)], points) <= 1e-9]
        if len(points) == 0:
            raise InvalidValue(f"a disc of {radius} m fits nowhere in {room or 'the building'}")
        x, y = points[rng.integers(len(points))] + rng.uniform(-CELL / 4, CELL / 4, 2)
        return Pose2(float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
