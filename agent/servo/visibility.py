"""Which landmarks the servo counts on."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.servo.field_of_view import FieldOfView
from mapweave.agent.servo.margins import MIN_VISIBLE
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2

MIN_DEPTH = 0.1
"""Nearer landmarks do not count, m."""
MOST_LANDMARKS = 24
"""How many landmarks ways are checked against."""
MISSED_TICKS = 10
"""A landmark that should be in view and is not tracked this long is not counted on."""


_WELL_INSIDE = 0.1
"""rad, a landmark with this much room should be tracked."""


class Visibility:
    """The known landmarks, less those that should be in view and have not been tracked for a while.

    Attributes:
        field: of the landmarks counted on.
        planning_field: of some of them, for ways.
    """

    def __init__(self, camera: Camera) -> None:
        """Begin without landmarks."""
        self._camera = camera
        self._points = np.zeros((0, 3))
        self._missed = np.zeros(0, dtype=int)
        self._used = np.zeros(0, dtype=bool)
        self._all = self._field(self._points)
        self.field = self.planning_field = self._all

    def update(
        self, goal_from_robot: Pose2, points_in_goal: NDArray[Any], visible: NDArray[np.bool_] | None
    ) -> None:
        """Take one tick's landmarks.

        Args:
            goal_from_robot: where the robot is.
            points_in_goal: (N, 3) m, in goal; rows with NaN are never counted on.
            visible: (N,) which are tracked, or None if that is not known.
        """
        points = np.asarray(points_in_goal, dtype=np.float64)
        changed: bool = points.shape != self._points.shape or not np.array_equal(
            points, self._points, equal_nan=True
        )
        if changed:
            if len(points) != len(self._points):
                self._missed = np.zeros(len(points), dtype=int)
            self._points = points
            self._all = self._field(np.nan_to_num(points, posinf=0.0, neginf=0.0))
        usable: NDArray[np.bool_] = np.isfinite(points.sum(axis=1))
        if visible is not None and len(points):
            rooms = self._all.rooms(goal_from_robot.vector)
            absent = ~np.asarray(visible, dtype=bool) & (rooms > _WELL_INSIDE)
            self._missed[absent] += 1
            self._missed[np.asarray(visible, dtype=bool)] = 0
            usable = usable & (self._missed < MISSED_TICKS)
        if changed or not np.array_equal(usable, self._used):
            self._used = usable
            self.field = self._field(points[usable])
            self.planning_field = self.field.spread(MOST_LANDMARKS)

    def _field(self, points: NDArray[Any]) -> FieldOfView:
        return FieldOfView(points, self._camera, MIN_VISIBLE, MIN_DEPTH)
