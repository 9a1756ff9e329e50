"""The inner loops of hypothetical postures, as machine code; algebra.py has the same in NumPy.

A recognition makes two hundred hypotheses of two or three sightings and evaluates them on a few dozen: arrays
so small that calling array operations costs ten times what they compute.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybridmap.machine_code import CUBE, MATRIX, VECTOR, machine_code
from hybridmap.pose import Array

FLAGS = "boolean[::1]"


@machine_code(
    MATRIX,
    MATRIX,
    CUBE,
    MATRIX,
    "float64",
    VECTOR,
    VECTOR,
    FLAGS,
    VECTOR,
    MATRIX,
    "float64",
    "float64",
    "float64",
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
    """See hybridmap.recognising.algebra."""
    fx, fy, mount_height, mount_forward, area = optics
    out = np.zeros((len(poses), len(points)))
    base = math.log(area / (2 * math.pi))
    for h in range(len(poses)):
        x, y = poses[h, 0], poses[h, 1]
        c, s = math.cos(poses[h, 2]), math.sin(poses[h, 2])
        for n in range(len(points)):
            dx, dy = points[n, 0] - x, points[n, 1] - y
            ahead = c * dx + s * dy - mount_forward
            if not ahead > nearest:
                continue
            inverse = 1.0 / ahead
            a, b = (c * dy - s * dx) * inverse, (points[n, 2] - mount_height) * inverse
            ru, rv = fx * (a - slopes[n, 0]), fy * (b - slopes[n, 1])
            # The point's covariance in the axes of the hypothetical robot.
            p00, p01, p11 = covariances[n, 0, 0], covariances[n, 0, 1], covariances[n, 1, 1]
            p02, p12 = covariances[n, 0, 2], covariances[n, 1, 2]
            pxx = c * c * p00 + 2 * c * s * p01 + s * s * p11
            pyy = s * s * p00 - 2 * c * s * p01 + c * c * p11
            pxy = c * s * (p11 - p00) + (c * c - s * s) * p01
            pxz, pyz = c * p02 + s * p12, c * p12 - s * p02
            fu, fv = fx * inverse, fy * inverse
            suu = fu * fu * (a * (a * pxx - 2 * pxy) + pyy) + pixel_variance
            svv = fv * fv * (b * (b * pxx - 2 * pxz) + covariances[n, 2, 2]) + pixel_variance
            suv = fu * fv * (b * (a * pxx - pxy) - a * pxz + pyz)
            determinant = suu * svv - suv * suv
            distance2 = (svv * ru * ru - 2 * suv * ru * rv + suu * rv * rv) / determinant
            if not distance2 < gate:
                continue
            ratio = base - 0.5 * math.log(determinant) - 0.5 * distance2
            if measured[n]:
                # The depth is treated as independent of the pixel here; the refinement does not.
                variance = pxx + depth_sigmas[n] ** 2
                depth2 = (ahead - depths[n]) ** 2 / variance
                if not depth2 < gate:
                    continue
                ratio += (
                    math.log(depths[n]) + log_decades - 0.5 * math.log(2 * math.pi * variance) - 0.5 * depth2
                )
            out[h, n] = max(ratio, 0.0)
    return out


@machine_code(MATRIX, CUBE, "float64")
def from_three_bearings(sets: Array, mount_forward: float) -> Array:
    """See hybridmap.recognising.algebra."""
    found = np.full((len(sets), 3), math.nan)
    for h in range(len(sets)):
        rows = np.empty((3, 3))
        for k in range(3):
            px, py, a = sets[h, k]
            rows[k, 0], rows[k, 1], rows[k, 2] = py - a * px, -px - a * py, a
        f, g = rows[0] - rows[1], rows[0] - rows[2]
        n0, n1 = f[1] * g[2] - f[2] * g[1], f[2] * g[0] - f[0] * g[2]
        n2 = f[0] * g[1] - f[1] * g[0]
        length = math.hypot(n0, n1)
        if not length > 0.0:
            continue
        b = (rows[0, 0] * n0 + rows[0, 1] * n1 + rows[0, 2] * n2) / length
        c, s, big_a = n0 / length, n1 / length, n2 / length
        # The null vector's sign is open: the points are in front of the camera.
        ahead = 0.0
        for k in range(3):
            ahead += c * sets[h, k, 0] + s * sets[h, k, 1] - big_a
        if ahead == 0.0:
            continue
        if ahead < 0.0:
            c, s, big_a, b = -c, -s, -big_a, -b
        found[h, 0], found[h, 1] = c * (big_a - mount_forward) - s * b, s * (big_a - mount_forward) + c * b
        found[h, 2] = math.atan2(s, c)
    return found


@machine_code(MATRIX, CUBE, CUBE)
def from_two_points(there: Array, here: Array) -> Array:
    """See hybridmap.recognising.algebra."""
    found = np.empty((len(here), 3))
    for h in range(len(here)):
        p, q = there[h], here[h]
        heading = math.atan2(p[1, 1] - p[0, 1], p[1, 0] - p[0, 0])
        heading -= math.atan2(q[1, 1] - q[0, 1], q[1, 0] - q[0, 0])
        c, s = math.cos(heading), math.sin(heading)
        qx, qy = 0.5 * (q[0, 0] + q[1, 0]), 0.5 * (q[0, 1] + q[1, 1])
        found[h, 0] = 0.5 * (p[0, 0] + p[1, 0]) - c * qx + s * qy
        found[h, 1] = 0.5 * (p[0, 1] + p[1, 1]) - s * qx - c * qy
        found[h, 2] = heading
    return found
