"""The equidistant fisheye lens, and the part of its field that an ideal camera can show."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array

WIDEST = math.radians(50.0)
"""Half the ideal image's field of view at most, rad. Its scale grows by 1 / cos^2 from the axis outwards;
with 60 degrees maps get worse (docs/decisions/fisheye.md)."""
LEAST_SLOPE = 0.05
"""Slope of the radius over the angle, 1 on the axis: below this a lens shows nothing any more, then folds."""
STEPS = 20
"""Newton's steps at most; five are enough but for angles near a fold."""


@dataclass(frozen=True)
class Equidistant:
    """Kannala and Brandt's lens (2006) as in OpenCV's `fisheye`, ROS' and Kalibr's `equidistant`.

    A ray at an angle theta from the axis is seen at the radius
    theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).

    Attributes:
        fx: focal length, px.
        fy: focal length, px.
        cx: principal point, px.
        cy: principal point, px.
        k: coefficients k1 to k4.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse what no lens can be.

        Raises:
            InvalidValue: a number is out of range, or the lens folds within the field that is used.
        """
        if not all(math.isfinite(n) for n in (self.fx, self.fy, self.cx, self.cy, *self.k)):
            raise InvalidValue("camera: every number must be finite")
        if self.fx <= 0 or self.fy <= 0:
            raise InvalidValue("camera: focal lengths must be positive")
        angles = np.linspace(0.0, WIDEST, 200)
        folded = self._slope(angles) < LEAST_SLOPE
        if folded.any():
            raise InvalidValue(
                f"camera: an equidistant lens with coefficients {list(self.k)} folds its image over "
                f"{math.degrees(angles[folded.argmax()]):.0f} degrees from the axis; calibrate it again with "
                "views of the board near the image's corners"
            )

    def project(self, rays: NDArray[Any]) -> Array:
        """(N, 2) tangents x / z and y / z of rays -> (N, 2) px in the real image."""
        rays = np.asarray(rays, dtype=np.float64)
        tangent = np.hypot(rays[:, 0], rays[:, 1])
        radius = self._radius(np.arctan(tangent))
        # The ratio is 1 on the axis.
        scale = np.where(tangent > 1e-9, radius / np.maximum(tangent, 1e-9), 1.0)
        return rays * scale[:, None] * [self.fx, self.fy] + [self.cx, self.cy]

    def rays(self, pixels: NDArray[Any]) -> Array:
        """(N, 2) px in the real image -> (N, 2) tangents; NaN beyond 80 degrees from the axis."""
        pixels = np.asarray(pixels, dtype=np.float64)
        plane = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        radius = np.hypot(plane[:, 0], plane[:, 1])
        angle = self._angle(radius)
        scale = np.where(radius > 1e-9, np.tan(angle) / np.maximum(radius, 1e-9), 1.0)
        return np.asarray(plane * scale[:, None])

    def ideal(self, width: int, height: int, mount_height: float, mount_forward: float = 0.0) -> Camera:
        """The pinhole camera that shows the middle of the lens's field, in an image of the same size.

        Its image reaches as far to the sides as the lens sees, but not further than `WIDEST`.
        """
        edge = max(self.cx, width - 1 - self.cx) / self.fx
        angle = float(np.nan_to_num(self._angle(np.array([edge])), nan=WIDEST)[0])
        cx, cy = 0.5 * (width - 1), 0.5 * (height - 1)
        focal = cx / math.tan(min(angle, WIDEST))
        return Camera(width, height, focal, focal, cx, cy, mount_height, mount_forward)

    def scaled(self, across: float, down: float) -> Equidistant:
        """The lens on an image of another size, by its ratios; the middle of the first pixel is 0."""
        cx, cy = (self.cx + 0.5) * across - 0.5, (self.cy + 0.5) * down - 0.5
        return Equidistant(self.fx * across, self.fy * down, cx, cy, self.k)

    def _radius(self, angle: Array) -> Array:
        k1, k2, k3, k4 = self.k
        s = angle * angle
        return np.asarray(angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))))

    def _slope(self, angle: Array) -> Array:
        k1, k2, k3, k4 = self.k
        s = angle * angle
        return np.asarray(1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4))))

    def _angle(self, radius: Array) -> Array:
        """Angles from the axis at radii; NaN where there is none below 80 degrees on this side of a fold."""
        angles = np.linspace(0.0, math.radians(80.0), 400)
        rising = self._slope(angles) >= LEAST_SLOPE
        last = len(angles) if rising.all() else int((~rising).argmax())
        table = self._radius(angles[:last])
        angle = np.interp(radius, table, angles[:last])
        for _ in range(STEPS):
            step = (self._radius(angle) - radius) / np.maximum(self._slope(angle), LEAST_SLOPE)
            angle = np.clip(angle - step, 0.0, angles[last - 1])
            if not len(step) or np.abs(step).max() < 1e-14:
                break
        return np.asarray(np.where(radius <= table[-1], angle, np.nan))
