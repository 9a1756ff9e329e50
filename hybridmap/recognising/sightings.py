"""Known points seen in an image of a planar robot: prediction, uncertainty and likelihood.

Geometry, for a robot at (x, y, heading) of the points' frame whose camera stands `mount_forward` ahead of the
axle and looks along the robot's x axis: with q the point in the robot frame,
    X = q_x - mount_forward,  Y = q_y,  u = cx - fx Y / X,  v = cy - fy (q_z - mount_height) / X.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.pose import Array
from hybridmap.recognising.kernels import kernels
from hybridmap.recognising.pose_arrays import inverse_poses

NEAREST = 0.05
"""Points less than this ahead of the optical centre count as not visible, m."""

NO_DEPTH_SIGMA = 1e3
"""Stands for "depth not measured", m."""

DEPTH_DECADES = math.log(100.0)
"""A wrong match's depth may be anything over two decades, evenly in its logarithm."""

LOG_DECADES = math.log(DEPTH_DECADES)

GATES = (9.21, 11.34)
"""Chi-square 99 % points for 2 and 3 degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """N points that are known in one frame and were seen, rightly or wrongly matched, in one image.

    Attributes:
        points: (N, 3) m, in the frame where the robot's posture is wanted; finite.
        covariances: (N, 3, 3) m^2, of the points.
        pixels: (N, 2) px, where the image shows them.
        camera: that took the image.
        pixel_sigma: standard deviation of a pixel, px.
        depths: (N,) m, measured along the optical axis of the image; NaN where not measured.
        depth_sigmas: (N,) m, of these.
        inverted: the points are in the robot's frame, and the image was taken where the wanted posture's
            frame has its origin.
    """

    points: Array
    covariances: Array
    pixels: Array
    camera: Camera
    pixel_sigma: float
    depths: Array
    depth_sigmas: Array
    inverted: bool = False

    @staticmethod
    def build(
        points: NDArray[Any],
        pixels: NDArray[Any],
        camera: Camera,
        *,
        covariances: NDArray[Any] | None = None,
        pixel_sigma: float = 1.0,
        depths: NDArray[Any] | None = None,
        depth_sigmas: NDArray[Any] | None = None,
        inverted: bool = False,
    ) -> Sightings:
        """Fill in what is not given: exact points, no measured depths."""
        n = len(points)
        nothing = np.full(n, np.nan)
        return Sightings(
            np.asarray(points, dtype=np.float64).reshape(n, 3),
            np.zeros((n, 3, 3)) if covariances is None else np.asarray(covariances, dtype=np.float64),
            np.asarray(pixels, dtype=np.float64).reshape(n, 2),
            camera,
            pixel_sigma,
            nothing if depths is None else np.asarray(depths, dtype=np.float64),
            nothing if depth_sigmas is None else np.asarray(depth_sigmas, dtype=np.float64),
            inverted,
        )

    def __len__(self) -> int:
        """How many."""
        return len(self.points)

    def take(self, index: slice) -> Sightings:
        """Some of them."""
        return replace(
            self,
            points=np.ascontiguousarray(self.points[index]),
            covariances=np.ascontiguousarray(self.covariances[index]),
            pixels=np.ascontiguousarray(self.pixels[index]),
            depths=np.ascontiguousarray(self.depths[index]),
            depth_sigmas=np.ascontiguousarray(self.depth_sigmas[index]),
        )

    @property
    def slopes(self) -> Array:
        """(N, 2) Y / X and (Z - mount_height) / X of each pixel's ray."""
        c = self.camera
        slopes: Array = (np.array([c.cx, c.cy]) - self.pixels) / np.array([c.fx, c.fy])
        return slopes

    @property
    def depth_measured(self) -> NDArray[np.bool_]:
        """(N,) where the image gives a depth too."""
        return np.isfinite(self.depths) & np.isfinite(self.depth_sigmas)

    def log_ratios(self, poses: Array) -> Array:
        """How much likelier each sighting is under each posture than as a wrong match.

        A right match is Gaussian around the point's projection, with the point's covariance carried into
        the image and the pixel's noise added; a wrong one is anywhere in the image. So a point that is hardly
        known gives little, and one with an uncertain depth must still lie along its own short line.

        Args:
            poses: (H, 3) m, m, rad, wanted postures.

        Returns:
            (H, N) nats; 0 for sightings outside the 99 % gate or behind the camera.
        """
        camera = self.camera
        if self.inverted:
            poses = inverse_poses(poses)
        optics = (
            camera.fx,
            camera.fy,
            camera.mount_height,
            camera.mount_forward,
            camera.width * camera.height,
        )
        out: Array = kernels().log_ratios(
            self.points, self.covariances, self.slopes, self.pixel_sigma**2, self.depths, self.depth_sigmas,
            self.depth_measured, np.array(optics, np.float64), np.ascontiguousarray(poses),
            GATES[0], NEAREST, LOG_DECADES,
        )  # fmt: skip
        return out
