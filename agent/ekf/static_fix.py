"""Where the robot stands, from one image of known landmarks: least squares without a first guess."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue
from hybridmap.pose import Array, Pose2, PoseGaussian

HEADINGS = 72
STEPS = 8
LEAST = 4
"""Landmarks that a fix needs (paper, section 6)."""


@dataclass(frozen=True, eq=False)
class StaticFix:
    """A posture that explains one image.

    Attributes:
        node_from_robot: the posture.
        chi2: squared residuals over their variance and the degrees of freedom: about 1 if the landmarks
            and their pixels belong together.
    """

    node_from_robot: PoseGaussian
    chi2: float


def static_fix(
    camera: Camera, points: Array, covariances: Array, pixels: Array, pixel_sigma: float = 0.7
) -> StaticFix | None:
    """Fix the posture by n >= 4 known landmarks (paper, section 6).

    In the camera at heading t a point lies at depth d = cos t X + sin t Y - u and to the right by
    r = sin t X - cos t Y + v, with (u, v) the position turned by the heading. For a given heading the
    equations `a d = r` and `b d = down` are linear in (u, v), so the best position for each of many headings
    is found at once; the best of these is the start of Gauss-Newton on the reprojection error.

    Args:
        camera: that took the image.
        points: (N, 3) m, in the node's robot frame.
        covariances: (N, 3, 3) m^2, in the node's robot frame.
        pixels: (N, 2) px, where they are seen.
        pixel_sigma: standard deviation of a pixel, px.

    Returns:
        The fix, or None if there are too few landmarks or no posture has them in front of the camera.

    Raises:
        InvalidValue: shapes that do not belong together.
    """
    n = len(points)
    if points.shape != (n, 3) or covariances.shape != (n, 3, 3) or pixels.shape != (n, 2):
        raise InvalidValue("static fix: points, covariances and pixels do not belong together")
    if n < LEAST:
        return None
    slopes = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    posture = _best_start(points, camera.mount_height, slopes)
    if posture is None:
        return None
    focal = np.array([camera.fx, camera.fy])
    camera_posture, cost, information = posture, np.inf, np.eye(3)
    for _ in range(STEPS):
        expected, by_posture, by_point, depth = _project(camera_posture, points, camera.mount_height)
        if (depth < 0.01).any():
            return None
        spread = by_point @ covariances @ np.swapaxes(by_point, 1, 2)
        spread[:, [0, 1], [0, 1]] += (pixel_sigma / focal) ** 2
        weight = np.linalg.inv(spread)
        residual = slopes - expected
        cost = float(np.einsum("ni,nij,nj->", residual, weight, residual))
        information = np.einsum("nia,nij,njb->ab", by_posture, weight, by_posture)
        if np.linalg.cond(information) > 1e12:
            return None
        gradient = np.einsum("nia,nij,nj->a", by_posture, weight, residual)
        step = np.linalg.solve(information, gradient)
        camera_posture = camera_posture + step
        if float(step @ information @ step) < 1e-6:
            break
    # From the optical centre back to the axle; a right perturbation of the robot moves both alike.
    camera_pose = Pose2.from_vector(camera_posture)
    turn = np.eye(3)
    turn[:2, :2] = camera_pose.rotation.T
    camera_gaussian = PoseGaussian(camera_pose, turn @ np.linalg.inv(information) @ turn.T)
    mount = PoseGaussian(Pose2(-camera.mount_forward, 0.0, 0.0), np.zeros((3, 3)))
    return StaticFix(camera_gaussian @ mount, cost / (2 * n - 3))


def _best_start(points: Array, mount_height: float, slopes: Array) -> Array | None:
    """Posture (3,) of the optical centre that fits the linear equations best, over all headings."""
    t = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
    c, s = np.cos(t)[:, None], np.sin(t)[:, None]
    ahead = c * points[:, 0] + s * points[:, 1]
    right = s * points[:, 0] - c * points[:, 1]
    down = mount_height - points[:, 2]
    a, b = slopes.T
    # Unknown (u, v): a u + v = a ahead - right, and b u = b ahead - down.
    design = np.zeros((2 * len(a), 2))
    design[: len(a), 0], design[: len(a), 1], design[len(a) :, 0] = a, 1.0, b
    goal = np.concatenate([a * ahead - right, b * ahead - down], axis=1).T
    solution = np.linalg.lstsq(design, goal, rcond=None)[0]
    depth = ahead - solution[0][:, None]
    # Residuals as slopes, so that near landmarks do not count more than far ones.
    safe = np.where(depth > 0.01, depth, 1.0)
    error = np.square((design @ solution - goal) / np.concatenate([safe, safe], axis=1).T).sum(axis=0)
    error[(depth <= 0.01).any(axis=1)] = np.inf
    best = int(np.argmin(error))
    if not np.isfinite(error[best]):
        return None
    u, v = solution[:, best]
    cb, sb = float(np.cos(t[best])), float(np.sin(t[best]))
    return np.array([cb * u - sb * v, sb * u + cb * v, t[best]])


def _project(
    posture: Array, points: Array, mount_height: float
) -> tuple[Array, Array, Array, NDArray[np.float64]]:
    """Slopes (N, 2), their Jacobians by posture (N, 2, 3) and point (N, 2, 3), and depths (N,)."""
    c, s = np.cos(posture[2]), np.sin(posture[2])
    x, y = points[:, 0] - posture[0], points[:, 1] - posture[1]
    depth, right = c * x + s * y, s * x - c * y
    safe = np.where(depth > 0.01, depth, 0.01)
    slopes = np.stack([right, mount_height - points[:, 2]], axis=1) / safe[:, None]
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, :, 0] = -slopes * c
    by_point[:, :, 1] = -slopes * s
    by_point[:, 0, 0] += s
    by_point[:, 0, 1] -= c
    by_point[:, 1, 2] = -1.0
    by_point /= safe[:, None, None]
    by_posture = np.empty((len(points), 2, 3))
    by_posture[:, :, :2] = -by_point[:, :, :2]
    # Turning left by dt: right grows by depth, depth shrinks by right.
    by_posture[:, :, 2] = slopes * slopes[:, :1]
    by_posture[:, 0, 2] += 1.0
    return slopes, by_posture, by_point, depth
