"""Poses of a planar robot from the fewest sightings that determine one, many at once.

With the camera at (tx, ty, heading) of the points' frame, c and s the heading's cosine and sine,
    X = c px + s py - A,   Y = -s px + c py - B,   A = c tx + s ty,   B = -s tx + c ty.
- Three bearings: Y = a X for a pixel with slope a is linear in (c, s, A, B). Two differences of three such
  rows lose B, and their cross product is (c, s, A) up to scale.
- Two points with depth: height over the camera and the pixel's row give a depth (or the image measures it),
  and a turn and a shift in the plane carry the two of the robot's frame upon the two of the points' frame.
"""

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.registration.pose_arrays import inverse_poses
from mapweave.registration.sightings import Sightings


def hypotheses(sightings: Sightings, count: int, rng: np.random.Generator) -> Array:
    """(H, 3) wanted poses from minimal sets of sightings; degenerate sets are left out."""
    minimal_poses = []
    if len(sightings) >= 3:
        minimal_poses.append(_from_three_bearings(sightings, rng.integers(0, len(sightings), (count, 3))))
    depths, sigmas = _depths(sightings)
    good = np.flatnonzero(sigmas < 0.3 * depths)
    if len(good) >= 2:
        chosen = good[rng.integers(0, len(good), (count, 2))]
        minimal_poses.append(_from_two_depths(sightings, chosen, depths))
    if not minimal_poses:
        return np.zeros((0, 3))
    poses = np.concatenate(minimal_poses)
    poses = poses[np.isfinite(poses).all(axis=1)]
    return inverse_poses(poses) if sightings.inverted else poses


def _from_three_bearings(sightings: Sightings, chosen: NDArray[np.int64]) -> Array:
    """(H, 3) poses from (H, 3) chosen sightings, by their horizontal bearings; NaN where degenerate."""
    px, py = sightings.points[:, 0][chosen], sightings.points[:, 1][chosen]
    a = sightings.slopes[:, 0][chosen]
    rows = np.stack([py - a * px, -px - a * py, a])
    (f0, f1, f2), (g0, g1, g2) = rows[..., 0] - rows[..., 1], rows[..., 0] - rows[..., 2]
    n0, n1, n2 = f1 * g2 - f2 * g1, f2 * g0 - f0 * g2, f0 * g1 - f1 * g0
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.hypot(n0, n1)
        # The null vector's sign is open: the points are in front of the camera.
        sign = np.sign(n0 * px.sum(axis=1) + n1 * py.sum(axis=1) - 3.0 * n2)
        scale *= np.where(sign == 0.0, np.nan, sign)
        c, s, big_a = n0 * scale, n1 * scale, n2 * scale
    big_b = rows[0, :, 0] * c + rows[1, :, 0] * s + rows[2, :, 0] * big_a
    ahead = big_a - sightings.camera.mount_forward
    return np.stack([c * ahead - s * big_b, s * ahead + c * big_b, np.arctan2(s, c)], axis=1)


def _depths(sightings: Sightings) -> tuple[Array, Array]:
    """(N,) depth in the image and its standard deviation, m, from heights and measured depths."""
    camera = sightings.camera
    height = sightings.points[:, 2] - camera.mount_height
    slope = sightings.slopes[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = height / slope
        relative2 = (sightings.pixel_sigma / (camera.fy * slope)) ** 2
        relative2 += sightings.covariances[:, 2, 2] / height**2
        weight = np.where(depth > 0, 1.0 / (relative2 * depth**2), 0.0)
    weight = np.where(np.isfinite(weight), weight, 0.0)
    depth = np.where(weight > 0, depth, 0.0)
    measured = sightings.depth_measured
    more = np.where(measured, 1.0 / np.where(measured, sightings.depth_sigmas, 1.0) ** 2, 0.0)
    total = weight + more
    with np.errstate(divide="ignore", invalid="ignore"):
        combined = (weight * depth + more * np.where(measured, sightings.depths, 0.0)) / total
        return np.where(total > 0, combined, np.nan), np.where(total > 0, total**-0.5, np.inf)


def _from_two_depths(sightings: Sightings, chosen: NDArray[np.int64], depths: Array) -> Array:
    """(H, 3) poses that carry two points of the robot's plane onto two points of the frame's."""
    ahead = depths[chosen]
    qx, qy = ahead + sightings.camera.mount_forward, ahead * sightings.slopes[:, 0][chosen]
    px, py = sightings.points[:, 0][chosen], sightings.points[:, 1][chosen]
    heading = np.arctan2(py[:, 1] - py[:, 0], px[:, 1] - px[:, 0])
    heading -= np.arctan2(qy[:, 1] - qy[:, 0], qx[:, 1] - qx[:, 0])
    c, s = np.cos(heading), np.sin(heading)
    # The middle of the two comes upon the middle.
    x = 0.5 * (px.sum(axis=1) - c * qx.sum(axis=1) + s * qy.sum(axis=1))
    y = 0.5 * (py.sum(axis=1) - s * qx.sum(axis=1) - c * qy.sum(axis=1))
    poses = np.stack([x, y, heading], axis=1)
    poses[chosen[:, 0] == chosen[:, 1]] = np.nan
    return poses
