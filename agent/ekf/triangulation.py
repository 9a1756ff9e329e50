"""Landmarks from tracks that no filter carries, given the trajectory that a filter found."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array

STEPS = 4
"""Most Gauss-Newton steps after the linear solution that they start from."""

SMALL_STEP = 0.01
"""A step of less than this many standard deviations, for every track, is the last."""

NEAREST = 1e-3
"""An observation from which the landmark would be nearer than this share of its depth is not used."""

ROUNDING = 1e-14
"""Share of a track's information that sums and inverses of it round away, and some more."""


class Triangulation(NamedTuple):
    """Landmarks seen from the reference pose, in columns; NaN where a track was seen less than twice.

    Attributes:
        rays: (N, 3) [a, b, w 1/m] at the reference, as in mapweave.agent.ekf.motion; w <= 0 means that the
            track may as well be at infinity.
        ray_covariances: (N, 3, 3) their covariances, the trajectory taken as true.
        depths: (N,) m along the optical axis of the reference; infinite for w <= 0.
        depth_sigmas: (N,) m, to first order; infinite for w <= 0.
        chi2: (N,) squared residuals over their variance and the degrees of freedom: about 1 for a track
            of one fixed point, more for one that slid or moved; NaN without degrees of freedom to spare.
    """

    rays: Array
    ray_covariances: Array
    depths: Array
    depth_sigmas: Array
    chi2: Array


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
    right, down = ((pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(right) & np.isfinite(down))
    right, down = np.where(seen, right, 0.0), np.where(seen, down, 0.0)
    enough = seen.sum(axis=1) >= 2
    solver = _Solver(depth_by, right_by, np.array([camera.fx, camera.fy]) / pixel_sigma)
    rays = solver.start(right, down, seen)
    for _ in range(STEPS):
        rays = rays + solver.step(rays, right, down, seen)
        if solver.largest_step < SMALL_STEP:
            break
    expected_right, expected_down, weight = solver.expect(rays, seen)
    used = weight > 0
    off_right = (right - expected_right) * used * solver.precision[0]
    off_down = (down - expected_down) * used * solver.precision[1]
    total = _over_images(off_right, off_right) + _over_images(off_down, off_down)
    freedom = 2.0 * used.sum(axis=1) - 3.0
    chi2 = np.where(freedom > 0, total / np.where(freedom > 0, freedom, 1.0), np.nan)
    rays[~enough] = np.nan
    solver.covariances[~enough] = np.nan
    return _answer(rays, solver.covariances, chi2)


class _Solver:
    """Normal equations of all tracks, summed over their observations without writing out the Jacobians.

    Slopes right / depth and down / depth are arrays (N, T) each.

    Attributes:
        precision: (2,) of a slope.
        covariances: (N, 3, 3) of the last step.
        largest_step: of any track in the last step, in standard deviations.
    """

    def __init__(self, depth_by: Array, right_by: Array, precision: Array) -> None:
        self.depth_by = depth_by
        self.right_by = right_by
        self.precision = precision
        self.covariances: Array = np.zeros((0, 3, 3))
        self.largest_step = math.inf

    def expect(self, rays: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """(N, T) slopes right and down expected, and 1 / depth, 1/m; 0 for observations that are not used."""
        rotated = np.stack([np.ones(len(rays)), rays[:, 0], rays[:, 2]], axis=1)
        depth = rotated @ self.depth_by
        used = seen & (depth > NEAREST)
        weight = used / np.where(used, depth, 1.0)
        return (rotated @ self.right_by) * weight, rays[:, 1:2] * weight, weight

    def start(self, right: Array, down: Array, seen: NDArray[np.bool_]) -> Array:
        """The linear solution, (N, 3): the step from (a, b, w) = 0 with the slopes as measured."""
        weight = seen.astype(np.float64)
        off_right = (right * self.depth_by[0] - self.right_by[0]) * weight
        return self._solve(right, down, weight, off_right, down * self.depth_by[0] * weight)

    def step(self, rays: Array, right: Array, down: Array, seen: NDArray[np.bool_]) -> Array:
        """The correction of the rays by one Gauss-Newton step, (N, 3)."""
        expected_right, expected_down, weight = self.expect(rays, seen)
        used = weight > 0
        off_right, off_down = (right - expected_right) * used, (down - expected_down) * used
        return self._solve(expected_right, expected_down, weight, off_right, off_down)

    def _solve(self, right: Array, down: Array, weight: Array, off_right: Array, off_down: Array) -> Array:
        """Least squares for what is `off`, linearized at the slopes right and down."""
        _, depth_by_a, depth_by_w = self.depth_by
        _, right_by_a, right_by_w = self.right_by
        by_right, by_down = self.precision
        scaled = weight * by_right
        right_a = (right_by_a - right * depth_by_a) * scaled
        right_w = (right_by_w - right * depth_by_w) * scaled
        down_b = weight * by_down
        down_a, down_w = -down * depth_by_a * down_b, -down * depth_by_w * down_b
        off_right, off_down = off_right * by_right, off_down * by_down
        information = np.empty((len(right), 3, 3))
        information[:, 0, 0] = _over_images(right_a, right_a) + _over_images(down_a, down_a)
        information[:, 2, 2] = _over_images(right_w, right_w) + _over_images(down_w, down_w)
        information[:, 1, 1] = _over_images(down_b, down_b)
        information[:, 0, 1] = information[:, 1, 0] = _over_images(down_a, down_b)
        information[:, 1, 2] = information[:, 2, 1] = _over_images(down_w, down_b)
        mixed = _over_images(right_a, right_w) + _over_images(down_a, down_w)
        information[:, 0, 2] = information[:, 2, 0] = mixed
        # The small prior only keeps tracks without parallax solvable: sigma 1e3 in slope and 1/m. It is more
        # than rounding where a camera comes next to where a track would be, and one slope outweighs all else.
        prior = np.maximum(1e-6, ROUNDING * np.trace(information, axis1=1, axis2=2))
        self.covariances = np.asarray(
            np.linalg.inv(information + prior[:, None, None] * np.eye(3)), np.float64
        )
        gradient = np.stack([
            _over_images(right_a, off_right) + _over_images(down_a, off_down),
            _over_images(down_b, off_down),
            _over_images(right_w, off_right) + _over_images(down_w, off_down),
        ], axis=1)  # fmt: skip
        step: Array = (self.covariances @ gradient[:, :, None])[:, :, 0]
        self.largest_step = math.sqrt(max(float(np.sum(step * gradient, axis=1).max(initial=0.0)), 0.0))
        return step


def _over_images(one: Array, other: Array) -> Array:
    """Sum of products (N,) of two arrays (N, T)."""
    return np.asarray(np.einsum("nt,nt->n", one, other), np.float64)


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


def _answer(rays: Array, covariances: Array, chi2: Array) -> Triangulation:
    w = rays[:, 2]
    finite = w > 0
    depths = np.where(finite, 1.0 / np.where(finite, w, 1.0), np.where(np.isnan(w), np.nan, np.inf))
    sigmas = np.sqrt(covariances[:, 2, 2]) * depths**2
    return Triangulation(rays, covariances, depths, sigmas, chi2)
