"""What the rangers saw, remembered: a robot that turns does not forget the wall that is now behind it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array, Pose2

CELL = 0.05
"""Two points in one square of this size are one, m."""
LIFE_TICKS = 600
"""How long a point that is not seen again is kept."""
MOST = 400
"""Points kept; the oldest go first."""


class ObstacleMemory:
    """Obstacle points in one fixed frame, one a cell, forgotten after a while."""

    def __init__(self) -> None:
        """Start with no map."""
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
            key = (round(x / CELL), round(y / CELL))
            fresh |= key not in self._points
            self._points.pop(key, None)
            self._points[key] = (x, y, self._tick)
        while self._points:
            oldest = next(iter(self._points))
            if len(self._points) <= MOST and self._tick - self._points[oldest][2] <= LIFE_TICKS:
                break
            del self._points[oldest]
        if len(points_in_frame) or len(self._points) != before:
            self._array = np.array([p[:2] for p in self._points.values()]).reshape(-1, 2)
        return fresh
