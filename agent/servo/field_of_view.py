"""The field of view as one number: the margin before too few landmarks are visible."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array

OUT = -math.pi
"""Room of a landmark that no heading brings into view, rad."""


class FieldOfView:
    """Which poses see enough of a set of landmarks.

    A landmark at distance r and height h from the optical centre is in the image while its bearing stays
    within a half-width w: |gamma| <= Delta, and also depth r cos(gamma) >= min_depth and
    |h| <= depth tan(vertical semi-aperture). The latter two bound cos(gamma) from below, so

        w = min(Delta, arccos(max(min_depth, |h| / tan(vertical)) / r))

    depends on the position alone. The slack of a pose is the `min_visible`-th largest of w_k - |gamma_k|:
    at least `min_visible` landmarks are seen exactly where it is >= 0. It changes by at most one radian a
    radian of turn, and is continuous, which is what a margin needs.
    """

    def __init__(
        self, points_in_goal: NDArray[Any], camera: Camera, min_visible: int = 4, min_depth: float = 0.1
    ) -> None:
        """Prepare.

        Args:
            points_in_goal: (N, 3) m, in the goal's robot frame, finite.
            camera: of the robot.
            min_visible: how many landmarks must be seen.
            min_depth: m, nearer landmarks do not count.

        Raises:
            InvalidValue: wrong shape or numbers that are not finite.
        """
        points = np.asarray(points_in_goal, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InvalidValue("servo: landmarks must be (N, 3) and finite")
        self.points = points
        self._camera, self._min_depth = camera, min_depth
        self.min_visible = min_visible
        self.semi_aperture = camera.semi_aperture
        self._mount_forward = camera.mount_forward
        rise = points[:, 2] - camera.mount_height
        up, down = camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
        self._least_depth = np.maximum(min_depth, np.where(rise > 0, rise / up, -rise / down))

    @property
    def count(self) -> int:
        """Number of landmarks."""
        return len(self.points)

    def _from_above(self, x: Array, y: Array) -> tuple[Array, Array]:
        """(..., N) direction and half-width of each landmark from optical centres at x, y (...)."""
        dx, dy = self.points[:, 0] - x[..., None], self.points[:, 1] - y[..., None]
        ratio = self._least_depth / np.maximum(np.sqrt(dx * dx + dy * dy), 1e-9)
        width = np.where(ratio < 1.0, np.arccos(np.minimum(ratio, 1.0)), OUT)
        return np.arctan2(dy, dx), np.minimum(width, self.semi_aperture)

    def rooms(self, poses: NDArray[Any]) -> Array:
        """(..., N) rad, w_k - |gamma_k| of each landmark at poses (..., 3) in goal; seen where >= 0."""
        poses = np.asarray(poses, dtype=np.float64)
        heading = poses[..., 2]
        direction, width = self._from_above(
            poses[..., 0] + self._mount_forward * np.cos(heading),
            poses[..., 1] + self._mount_forward * np.sin(heading),
        )
        gamma = direction - heading[..., None]
        gamma -= 2.0 * math.pi * np.round(gamma / (2.0 * math.pi))
        room: Array = width - np.abs(gamma)
        return room

    def _least(self, rooms: Array) -> Array:
        if self.count < self.min_visible:
            return np.full(rooms.shape[:-1], OUT)
        k = self.count - self.min_visible
        slack: Array = np.partition(rooms, k, axis=-1)[..., k]
        return slack

    def slack(self, poses: NDArray[Any]) -> Array:
        """(...) rad, room left at poses (..., 3) x m, y m, heading rad, in goal."""
        return self._least(self.rooms(poses))

    def spread(self, most: int) -> FieldOfView:
        """A stricter, faster field: at most `most` landmarks, evenly over the bearings at the goal."""
        if self.count <= most:
            return self
        order = np.argsort(np.arctan2(self.points[:, 1], self.points[:, 0]), kind="stable")
        chosen = np.sort(order[np.linspace(0, self.count - 1, most).round().astype(int)])
        return FieldOfView(self.points[chosen], self._camera, self.min_visible, self._min_depth)
