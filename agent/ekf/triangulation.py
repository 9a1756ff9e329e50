"""Landmarks from tracks that no filter carries, given the trajectory that a filter found."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array

STEPS = 4
"""Gauss-Newton steps after the linear solution that they start from."""

NEAREST = 1e-3
"""An observation from which the landmark would be nearer than this share of its depth is not used."""


class Triangulation(NamedTuple):
    """Landmarks seen from the reference pose, in columns; NaN where a track was seen less than twice.

    Attributes:
        rays: (N, 3) [a, b, w 1/m] at the reference, as in mapweave.agent.ekf.motion; w <= 0 means that the
            track may as well be at infinity.
        ray_covariances: (N, 3, 3) their covariances, the trajectory taken as true.
        points_in_robot: (N, 3) m, in the reference's robot frame; NaN for w <= 0.
        depths: (N,) m along the optical axis of the reference; infinite for w <= 0.
        depth_sigmas: (N,) m, to first order; infinite for w <= 0.
        chi2: (N,) squared residuals over their variance and the degrees of freedom: about 1 for a track
            of one fixed point, more for one that slid or moved; NaN without degrees of freedom to spare.
        seen: (N,) in how many images.
    """

    rays: Array
    ray_covariances: Array
    points_in_robot: Array
    depths: Array
    depth_sigmas: Array
    chi2: Array
    seen: NDArray[np.int64]


def triangulate(
    poses: Array, pixels: Array, camera: Camera, pixel_sigma: float = 0.7, reference: Array | None = None
) -> Triangulation:
    """Minimise the reprojection error of all tracks at once, in inverse depth.

    A landmark (a, b, 1) / w of the reference camera lies at (right, down, depth) / w in another, all three
    linear in (a, b, w). `measured slope * depth = right` is therefore linear in the unknowns, which gives a
    start that needs no guess; Gauss-Newton on `slope - right / depth` then removes its bias.

    Args:
        poses: (T, 3) [x m, y m, heading rad], anchor_from_robot at each image.
        pixels: (T, N, 2) px, undistorted; NaN where a track was not seen.
        camera: intrinsics and mount.
        pixel_sigma: standard deviation of a pixel, px.
        reference: (3,) anchor_from_robot of the pose in whose camera to answer; the last by default.

    Raises:
        InvalidValue: shapes that do not belong together.
    """
    if pixels.ndim != 3 or poses.shape != (len(pixels), 3) or not len(poses):
        raise InvalidValue(
            f"triangulate: poses {poses.shape} and pixels {pixels.shape} do not belong together"
        )
    depth_by, right_by = _camera_motion(poses, poses[-1] if reference is None else reference, camera)
    measured = (np.moveaxis(pixels, 0, 1) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(measured).all(axis=2))
    measured = np.where(seen[:, :, None], measured, 0.0)
    enough = seen.sum(axis=1) >= 2
    solver = _Solver(depth_by, right_by, np.array([camera.fx, camera.fy]) / pixel_sigma)
    # The linear solution is the step from (a, b, w) = 0 with the measured slopes in place of the expected.
    rays = solver.step(np.zeros((len(seen), 3)), measured, measured, np.where(seen, 1.0, 0.0), linear=True)
    for _ in range(STEPS):
        expected, weight = solver.expect(rays, seen)
        rays = rays + solver.step(rays, measured, expected, weight)
    expected, weight = solver.expect(rays, seen)
    residual = (measured - expected) * (weight > 0)[:, :, None] * solver.precision
    freedom = 2.0 * (weight > 0).sum(axis=1) - 3.0
    total = np.square(residual).sum(axis=(1, 2))
    chi2 = np.where(freedom > 0, total / np.where(freedom > 0, freedom, 1.0), np.nan)
    rays[~enough] = np.nan
    solver.covariances[~enough] = np.nan
    return _answer(rays, solver.covariances, chi2, seen.sum(axis=1), camera)


class _Solver:
    """Normal equations of all tracks.

    Attributes:
        precision: (2,) of a slope.
        covariances: (N, 3, 3) of the last step.
    """

    def __init__(self, depth_by: Array, right_by: Array, precision: Array) -> None:
        self.depth_by = depth_by
        self.right_by = right_by
        self.precision = precision
        self.covariances: Array = np.zeros((0, 3, 3))

    def expect(self, rays: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Slopes (N, T, 2) expected, and 1 / depth (N, T), 0 for observations that are not used."""
        rotated = np.stack([np.ones(len(rays)), rays[:, 0], rays[:, 2]], axis=1)
        depth = rotated @ self.depth_by
        used = seen & (depth > NEAREST)
        weight = used / np.where(used, depth, 1.0)
        expected = np.stack([rotated @ self.right_by, np.broadcast_to(rays[:, 1:2], depth.shape)], axis=-1)
        return expected * weight[:, :, None], weight

    def step(self, rays: Array, measured: Array, guess: Array, weight: Array, linear: bool = False) -> Array:
        """Solve the normal equations: the rays (linear) or their correction, (N, 3)."""
        n, t = weight.shape
        d, r, g = self.depth_by, self.right_by, guess
        jacobian = np.zeros((n, 2, t, 3))
        jacobian[:, 0, :, 0] = r[1] - g[:, :, 0] * d[1]
        jacobian[:, 0, :, 2] = r[2] - g[:, :, 0] * d[2]
        jacobian[:, 1, :, 0] = -g[:, :, 1] * d[1]
        jacobian[:, 1, :, 1] = 1.0
        jacobian[:, 1, :, 2] = -g[:, :, 1] * d[2]
        jacobian *= (weight[:, None] * self.precision[:, None])[..., None]
        if linear:
            goal = np.stack([g[:, :, 0] * d[0] - r[0], g[:, :, 1] * d[0]], axis=1) * weight[:, None]
        else:
            goal = np.swapaxes((measured - guess) * (weight > 0)[:, :, None], 1, 2)
        flat = jacobian.reshape(n, 2 * t, 3)
        transposed = np.swapaxes(flat, 1, 2)
        # The small prior only keeps tracks without parallax solvable: sigma 1e3 in slope and 1/m.
        self.covariances = np.asarray(np.linalg.inv(transposed @ flat + 1e-6 * np.eye(3)), np.float64)
        weighted = (goal * self.precision[:, None]).reshape(n, 2 * t, 1)
        return (self.covariances @ (transposed @ weighted))[:, :, 0]


def _camera_motion(poses: Array, reference: Array, camera: Camera) -> tuple[Array, Array]:
    """Depth and right of a landmark at each pose, each (3, T), by (1, a, w) at the reference."""
    turn = poses[:, 2] - reference[2]
    c, s = np.cos(reference[2]), np.sin(reference[2])
    x, y = poses[:, 0] - reference[0], poses[:, 1] - reference[1]
    cosine, sine = np.cos(turn), np.sin(turn)
    forward = c * x + s * y + camera.mount_forward * (cosine - 1.0)
    left = -s * x + c * y + camera.mount_forward * sine
    depth_by = np.stack([cosine, -sine, -(cosine * forward + sine * left)])
    right_by = np.stack([sine, cosine, cosine * left - sine * forward])
    return depth_by, right_by


def _answer(
    rays: Array, covariances: Array, chi2: Array, seen: NDArray[np.int64], camera: Camera
) -> Triangulation:
    w = rays[:, 2]
    finite = w > 0
    depths = np.where(finite, 1.0 / np.where(finite, w, 1.0), np.where(np.isnan(w), np.nan, np.inf))
    sigmas = np.sqrt(covariances[:, 2, 2]) * depths**2
    points = camera.back_project(
        rays[:, :2] * (camera.fx, camera.fy) + (camera.cx, camera.cy), np.where(finite, depths, np.nan)
    )
    return Triangulation(rays, covariances, points, depths, sigmas, chi2, seen)
