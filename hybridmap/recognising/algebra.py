"""The inner loops of matching and of planar postures in NumPy.

compiled.py has them as machine code, kernels.py chooses. Both forms give the same to rounding.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybridmap.pose import Array, Pose2

Nearest = tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]
"""Of each row or column: index of the nearest, its distance, the second nearest's."""

Linear = tuple[Array, Array, Array, Array, Array, Array, Array, NDArray[np.bool_], Array]
"""The fields of hybridmap.recognising.pose_refinement.Linear."""


def squared_steps(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int32]:
    """(N, D) and (M, D) codes below 64 -> (N, M) squared distances in whole steps, exact."""
    # Whole numbers below 2^24 are exact in float32.
    x, y = a.astype(np.float32), b.astype(np.float32)
    squared = (x * x).sum(axis=1)[:, None] + (y * y).sum(axis=1)[None] - 2 * (x @ y.T)
    out: NDArray[np.int32] = squared.astype(np.int32)
    return out


def two_nearest(squared: NDArray[np.float32]) -> tuple[Nearest, Nearest]:
    """The nearest of each row and of each column, with how near the second nearest is.

    Args:
        squared: (N, M) distances, N and M at least 1.

    Returns:
        Of rows and of columns; the second distance is infinite if there is one entry only. Of equals the
        first one is nearest, and the next one second.
    """

    def along(table: NDArray[np.float32]) -> Nearest:
        best = table.argmin(axis=1)
        least = table[np.arange(len(table)), best]
        if table.shape[1] < 2:
            return best, least, np.full(len(table), np.inf, np.float32)
        return best, least, np.partition(table, 1, axis=1)[:, 1]

    return along(squared), along(squared.T)


def from_three_bearings(sets: Array, mount_forward: float) -> Array:
    """(H, 3) postures, NaN where degenerate; see hybridmap.recognising.minimal_poses.

    Args:
        sets: (H, 3, 3) x, y m and horizontal slope of three sightings each.
        mount_forward: of the camera, m.
    """
    px, py, a = sets[..., 0], sets[..., 1], sets[..., 2]
    rows = np.stack([py - a * px, -px - a * py, a], axis=-1)
    solution = np.cross(rows[:, 0] - rows[:, 1], rows[:, 0] - rows[:, 2])
    b = (rows[:, 0] * solution).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.hypot(solution[:, 0], solution[:, 1])
        c, s, big_a, big_b = solution[:, 0] * scale, solution[:, 1] * scale, solution[:, 2] * scale, b * scale
        # The null vector's sign is open: the points are in front of the camera.
        sign = np.sign((c[:, None] * px + s[:, None] * py - big_a[:, None]).sum(axis=1))
        sign[sign == 0] = np.nan
        c, s, big_a, big_b = c * sign, s * sign, big_a * sign, big_b * sign
    return np.stack(
        [c * (big_a - mount_forward) - s * big_b, s * (big_a - mount_forward) + c * big_b, np.arctan2(s, c)],
        axis=1,
    )


def from_two_points(there: Array, here: Array) -> Array:
    """(H, 3) postures that carry two points of the robot's plane, `here`, onto two of the frame's, `there`.

    Args:
        there: (H, 2, 2) x, y m in the frame.
        here: (H, 2, 2) x, y m in the robot's.
    """
    dp, dq = there[:, 1] - there[:, 0], here[:, 1] - here[:, 0]
    heading = np.arctan2(dp[:, 1], dp[:, 0]) - np.arctan2(dq[:, 1], dq[:, 0])
    c, s = np.cos(heading), np.sin(heading)
    p, q = there.mean(axis=1), here.mean(axis=1)
    return np.stack(
        [p[:, 0] - c * q[:, 0] + s * q[:, 1], p[:, 1] - s * q[:, 0] - c * q[:, 1], heading], axis=1
    )


def log_ratios(
    points: Array,
    covariances: Array,
    slopes: Array,
    pixel_variance: float,
    depths: Array,
    depth_sigmas: Array,
    measured: NDArray[np.bool_],
    optics: Array,
    poses: Array,
    gate: float,
    nearest: float,
    log_decades: float,
) -> Array:
    """See hybridmap.recognising.sightings.

    Of the camera, `optics` has fx, fy px, mount_height, mount_forward m and the image's area, px^2.
    """
    fx, fy, mount_height, mount_forward, area = optics.tolist()
    cos, sin = np.cos(poses[:, 2:3]), np.sin(poses[:, 2:3])
    dx, dy = points[:, 0] - poses[:, 0:1], points[:, 1] - poses[:, 1:2]
    ahead = cos * dx + sin * dy - mount_forward
    visible = ahead > nearest
    inverse = 1.0 / np.where(visible, ahead, 1.0)
    a, b = (cos * dy - sin * dx) * inverse, (points[:, 2] - mount_height) * inverse
    ru, rv = fx * (a - slopes[:, 0]), fy * (b - slopes[:, 1])

    # The points' covariances in the axes of each hypothetical robot, one matrix product an entry.
    p = covariances
    plan = np.stack([p[:, 0, 0], p[:, 0, 1], p[:, 1, 1]])
    tilt = np.stack([p[:, 0, 2], p[:, 1, 2]])
    cc, ss, cs = cos * cos, sin * sin, cos * sin
    pxx = np.hstack([cc, 2 * cs, ss]) @ plan
    pyy = np.hstack([ss, -2 * cs, cc]) @ plan
    pxy = np.hstack([-cs, cc - ss, cs]) @ plan
    pxz, pyz = np.hstack([cos, sin]) @ tilt, np.hstack([-sin, cos]) @ tilt
    fu, fv = fx * inverse, fy * inverse
    suu = fu * fu * (a * (a * pxx - 2 * pxy) + pyy) + pixel_variance
    svv = fv * fv * (b * (b * pxx - 2 * pxz) + p[:, 2, 2]) + pixel_variance
    suv = fu * fv * (b * (a * pxx - pxy) - a * pxz + pyz)
    determinant = suu * svv - suv * suv
    distance2 = (svv * ru * ru - 2 * suv * ru * rv + suu * rv * rv) / determinant

    ratios = math.log(area / (2 * math.pi)) - 0.5 * np.log(determinant) - 0.5 * distance2
    kept = visible & (distance2 < gate)
    if measured.any():
        # The depth is treated as independent of the pixel here; the refinement does not.
        variance = pxx[:, measured] + depth_sigmas[measured] ** 2
        depth2 = (ahead[:, measured] - depths[measured]) ** 2 / variance
        ratios[:, measured] += np.log(depths[measured]) + log_decades - 0.5 * np.log(2 * math.pi * variance)
        ratios[:, measured] -= 0.5 * depth2
        kept[:, measured] &= depth2 < gate
    out: Array = np.where(kept, np.maximum(ratios, 0.0), 0.0)
    return out


def predict(
    points: Array, inverted: NDArray[np.bool_], optics: Array, wanted: Array, nearest: float
) -> tuple[Array, Array, Array]:
    """See hybridmap.recognising.pose_refinement.Stack.predict."""
    fx, fy, cx, cy, mount_height, mount_forward = optics
    posture = Pose2.from_vector(wanted)
    back = posture.inverse()
    x, y = np.where(inverted, back.x, posture.x), np.where(inverted, back.y, posture.y)
    cos, sin = math.cos(posture.heading), math.sin(posture.heading) * np.where(inverted, -1.0, 1.0)
    dx, dy = points[:, 0] - x, points[:, 1] - y
    forward, left = cos * dx + sin * dy, cos * dy - sin * dx
    ahead = forward - mount_forward
    inverse = 1.0 / np.where(ahead > nearest, ahead, np.nan)
    a, b = left * inverse, (points[:, 2] - mount_height) * inverse
    predicted = np.stack([cx - fx * a, cy - fy * b, ahead], axis=-1)

    # By the point in robot axes, columns forward and left (up is the same in both frames).
    u_forward, u_left, v_forward, v_up = fx * inverse * a, -fx * inverse, fy * inverse * b, -fy * inverse
    by_point = np.zeros((len(points), 3, 3))
    by_point[:, 0, 0], by_point[:, 0, 1] = u_forward * cos - u_left * sin, u_forward * sin + u_left * cos
    by_point[:, 1, 0], by_point[:, 1, 1], by_point[:, 1, 2] = v_forward * cos, v_forward * sin, v_up
    by_point[:, 2, 0], by_point[:, 2, 1] = cos, sin
    # A posture step (dx, dy, dh) moves the point in robot axes by (-dx + dh left, -dy - dh forward).
    by_pose = np.zeros((len(points), 3, 3))
    by_pose[:, 0, 0], by_pose[:, 0, 1] = -u_forward, -u_left
    by_pose[:, 0, 2] = u_forward * left - u_left * forward
    by_pose[:, 1, 0], by_pose[:, 1, 2] = -v_forward, v_forward * left
    by_pose[:, 2, 0], by_pose[:, 2, 2] = -1.0, left
    if inverted.any():
        # inverse(wanted @ d) = inverse(wanted) @ (-Ad(wanted) d) to first order.
        by_pose[inverted] = by_pose[inverted] @ -posture.adjoint
    return predicted, by_pose, by_point


def linearise(
    points: Array,
    covariances: Array,
    observed: Array,
    noise: Array,
    measured: NDArray[np.bool_],
    gates: Array,
    log_wrong: Array,
    inverted: NDArray[np.bool_],
    optics: Array,
    wanted: Array,
    moved: Array,
    nearest: float,
) -> Linear:
    """The fields of pose_refinement.Linear, of a stack's columns, a posture and points."""
    predicted, by_pose, by_point = predict(moved, inverted, optics, wanted, nearest)
    off = observed - predicted
    off[~measured, 2] = 0.0
    back = (by_point @ (points - moved)[:, :, None])[:, :, 0]
    back[~measured, 2] = 0.0
    residuals = off - back
    visible = np.isfinite(residuals).all(axis=1)
    if not visible.all():
        for part in (residuals, by_pose, by_point):
            part[~visible] = 0.0
    spread = by_point @ covariances @ by_point.transpose(0, 2, 1)
    spread[:, [0, 1, 2], [0, 1, 2]] += noise
    information = np.linalg.inv(spread).astype(np.float64, copy=False)
    distance2 = (residuals * (information @ residuals[:, :, None])[:, :, 0]).sum(axis=1)
    ratios = log_wrong - 0.5 * (np.log(np.linalg.det(spread)) + distance2)
    inliers = visible & (distance2 < gates) & (ratios > 0)
    weights = np.where(inliers, 1.0 / (1.0 + np.exp(-np.clip(ratios, -30, 30))), 0.0)
    return residuals, off[:, :2], by_pose, by_point, information, distance2, ratios, inliers, weights


def normal_equations(
    residuals: Array, by_pose: Array, information: Array, weights: Array
) -> tuple[Array, Array]:
    """(3, 3) information of the posture and (3,) gradient, of sightings that count by their weights."""
    weighted = (information @ by_pose * weights[:, None, None]).reshape(-1, 3).T
    return weighted @ by_pose.reshape(-1, 3), weighted @ residuals.ravel()


def determined(information: Array) -> bool:
    """Whether it is far from singular; lengths and angles count alike at about 1 m."""
    if not np.isfinite(information).all():
        return False
    values = np.linalg.eigvalsh(information)
    return bool(values[0] > 1e-9 * max(values[-1], 1e-300))


def improve(
    points: Array,
    covariances: Array,
    observed: Array,
    noise: Array,
    measured: NDArray[np.bool_],
    gates: Array,
    log_wrong: Array,
    inverted: NDArray[np.bool_],
    optics: Array,
    start: Array,
    prior: Array,
    prior_information: Array,
    rounds: int,
    nearest: float,
    small_step: float,
) -> tuple[bool, Array, Array]:
    """See pose_refinement; whether a posture is determined, the posture, and the points."""
    stack = points, covariances, observed, noise, measured, gates, log_wrong, inverted, optics
    pose, moved = Pose2.from_vector(start), points
    for _ in range(rounds):
        residuals, _, by_pose, by_point, weight, _, _, inliers, weights = linearise(
            *stack, pose.vector, moved, nearest
        )
        total, gradient = normal_equations(residuals, by_pose, weight, weights)
        total = total + prior_information
        gradient = gradient + prior_information @ (pose.inverse() @ Pose2.from_vector(prior)).vector
        if not determined(total):
            return False, pose.vector, moved
        step = np.linalg.solve(total, gradient)
        pose = pose @ Pose2.from_vector(step)
        left = (residuals - by_pose @ step)[:, :, None]
        pulled = points + (covariances @ by_point.transpose(0, 2, 1) @ weight @ left)[:, :, 0]
        moved = np.where(inliers[:, None], pulled, points)
        if np.abs(step).max() < small_step:
            break
    return True, pose.vector, moved
