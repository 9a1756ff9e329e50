"""Known points seen in an image of a planar robot: prediction, uncertainty and likelihood.

Geometry, for a robot at (x, y, heading) of the points' frame whose camera is `mount_forward` ahead of the
axle and faces along the robot's x axis: with q the point in the robot frame,
    X = q_x - mount_forward,  Y = q_y,  u = cx - fx Y / X,  v = cy - fy (q_z - mount_height) / X.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array
from mapweave.registration.pose_arrays import inverse_poses
from mapweave.registration.projection import CameraSightings, Optics, PoseHypotheses, log_ratios


@dataclass(frozen=True, eq=False)
class Sightings:
    """N points that are known in one frame and were seen, rightly or wrongly matched, in one image.

    Attributes:
        points: (N, 3) m, in the frame where the robot's pose is wanted; finite.
        covariances: (N, 3, 3) m^2, of the points.
        pixels: (N, 2) px, where the image shows them.
        camera: that took the image.
        pixel_sigma: standard deviation of a pixel, px.
        depths: (N,) m, measured along the optical axis of the image; NaN where not measured.
        depth_sigmas: (N,) m, of these.
        inverted: the points are in the robot's frame, and the image was taken where the wanted pose's
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

    def levelled(self, pitch: float) -> Sightings:
        """The sightings as a level camera would have seen them, see projection.py.

        Args:
            pitch: by which the camera looks up against the points' frame, rad; where inverted, the robot's.
        """
        if not pitch:
            return self
        camera, (a, b) = self.camera, self.slopes.T
        up, down = math.cos(pitch), math.sin(-pitch if self.inverted else pitch)
        ray = up - b * down
        level = np.column_stack([a / ray, (down + b * up) / ray])
        return replace(self, pixels=[camera.cx, camera.cy] - np.array([camera.fx, camera.fy]) * level)

    def log_ratios(self, poses: Array, pitch_sigma: float = 0.0) -> Array:
        """Log likelihood ratio of each sighting under each pose against a wrong match.

        A right match is Gaussian around the point's projection, with the point's covariance carried into
        the image and the pixel's noise added; a wrong one is anywhere in the image. So a point that is hardly
        known gives little, and one with an uncertain depth must still lie along its own short line.

        Args:
            poses: (H, 3) m, m, rad, wanted poses.
            pitch_sigma: rad, by which the camera may be pitched; as noise of each pixel, which is what it is
                as long as nothing is known of it.

        Returns:
            (H, N) nats; 0 for sightings outside the 99 % gate or behind the camera.
        """
        camera, measured = self.camera, self.depth_measured
        if self.inverted:
            poses = inverse_poses(poses)
        area = float(camera.width * camera.height)
        seen = CameraSightings(
            self.points,
            self.covariances,
            self.slopes,
            np.where(measured, self.depths, 1.0),
            np.where(measured, self.depth_sigmas, 1.0) ** 2,
            measured,
            float(self.pixel_sigma**2),
            float(pitch_sigma**2),
            Optics(camera.fx, camera.fy, camera.mount_height, camera.mount_forward, area),
        )
        heading = poses[:, 2]
        return log_ratios(
            seen, PoseHypotheses(poses[:, 0].copy(), poses[:, 1].copy(), np.cos(heading), np.sin(heading))
        )
