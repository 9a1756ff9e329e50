"""What the rangers saw, remembered: a robot that turns does not forget the wall that is now behind it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array, Pose2


class ObstacleMemory:
    """Obstacle points in one fixed frame, one a cell, forgotten after a while."""

    def __init__(self, cell: float = 0.05, life_ticks: int = 600, most: int = 400) -> None:
        """Start with no map.

        Args:
            cell: m, two points in one square of this size are one.
            life_ticks: how long a point that is not seen again is kept.
            most: points kept; the oldest go first.
        """
        self._cell, self._life, self._most = cell, life_ticks, most
        self._points: dict[tuple[int, int], tuple[float, float, int]] = {}
        self._tick = 0
        self._array: Array = np.zeros((0, 2))

    @property
    def points(self) -> Array:
        """(K, 2) m."""
        return self._array

    def add(self, frame_from_robot: Pose2, points_in_robot: NDArray[Any]) -> bool:
        """Take one tick's points; returns whether a cell is new.

        Args:
            frame_from_robot: pose of the robot in the memory's frame.
            points_in_robot: (K, 2) m, in robot.
        """
        self._tick += 1
        before = len(self._points)
        points_in_frame = frame_from_robot.apply(np.asarray(points_in_robot, dtype=np.float64).reshape(-1, 2))
        fresh = False
        for x, y in points_in_frame.tolist():
            key = (round(x / self._cell), round(y / self._cell))
            fresh |= key not in self._points
            self._points.pop(key, None)
            self._points[key] = (x, y, self._tick)
        while self._points:
            oldest = next(iter(self._points))
            if len(self._points) <= self._most and self._tick - self._points[oldest][2] <= self._life:
                break
            del self._points[oldest]
        if len(points_in_frame) or len(self._points) != before:
            self._array = np.array([p[:2] for p in self._points.values()]).reshape(-1, 2)
        return fresh
