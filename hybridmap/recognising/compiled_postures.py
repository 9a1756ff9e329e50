"""The inner loops of planar postures, as machine code (hybridmap.recognising.algebra has the same in NumPy).

A recognition linearises a dozen times on a few dozen sightings: arrays so small that calling array operations
costs ten times what they compute.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.machine_code import CUBE, MATRIX, VECTOR, machine_code
from hybridmap.pose import Array

FLAGS = "boolean[::1]"
_STACK = (MATRIX, CUBE, MATRIX, MATRIX, FLAGS, VECTOR, VECTOR, FLAGS, MATRIX)
_LINEAR = f"Tuple(({MATRIX}, {MATRIX}, {CUBE}, {CUBE}, {CUBE}, {VECTOR}, {VECTOR}, {FLAGS}, {VECTOR}))"


@machine_code(f"Tuple(({MATRIX}, {CUBE}, {CUBE}))", MATRIX, FLAGS, MATRIX, VECTOR, "float64")
def predict(
    points: Array, inverted: NDArray[np.bool_], optics: Array, wanted: Array, nearest: float
) -> tuple[Array, Array, Array]:
    """See hybridmap.recognising.algebra."""
    count = len(points)
    predicted = np.empty((count, 3))
    by_pose, by_point = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
    c, s = math.cos(wanted[2]), math.sin(wanted[2])
    back_x, back_y = -c * wanted[0] - s * wanted[1], s * wanted[0] - c * wanted[1]
    for n in range(count):
        fx, fy, cx, cy, mount_height, mount_forward = optics[:, n]
        x, y, sin = (back_x, back_y, -s) if inverted[n] else (wanted[0], wanted[1], s)
        dx, dy = points[n, 0] - x, points[n, 1] - y
        forward, left = c * dx + sin * dy, c * dy - sin * dx
        ahead = forward - mount_forward
        inverse = 1.0 / ahead if ahead > nearest else math.nan
        a, b = left * inverse, (points[n, 2] - mount_height) * inverse
        predicted[n, 0], predicted[n, 1], predicted[n, 2] = cx - fx * a, cy - fy * b, ahead
        # By the point in robot axes, columns forward and left (up is the same in both frames).
        u_forward, u_left, v_forward, v_up = fx * inverse * a, -fx * inverse, fy * inverse * b, -fy * inverse
        by_point[n, 0, 0], by_point[n, 0, 1] = u_forward * c - u_left * sin, u_forward * sin + u_left * c
        by_point[n, 1, 0], by_point[n, 1, 1], by_point[n, 1, 2] = v_forward * c, v_forward * sin, v_up
        by_point[n, 2, 0], by_point[n, 2, 1] = c, sin
        # A posture step (dx, dy, dh) moves the point in robot axes by (-dx + dh left, -dy - dh forward).
        row = by_pose[n]
        row[0, 0], row[0, 1], row[0, 2] = -u_forward, -u_left, u_forward * left - u_left * forward
        row[1, 0], row[1, 2] = -v_forward, v_forward * left
        row[2, 0], row[2, 2] = -1.0, left
        if inverted[n]:
            # inverse(wanted @ d) = inverse(wanted) @ (-Ad(wanted) d) to first order.
            for k in range(3):
                along, aside, turn = row[k, 0], row[k, 1], row[k, 2]
                row[k, 0] = -(along * c + aside * s)
                row[k, 1] = along * s - aside * c
                row[k, 2] = -(along * wanted[1] - aside * wanted[0] + turn)
    return predicted, by_pose, by_point


@machine_code(_LINEAR, *_STACK, VECTOR, MATRIX, "float64")
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
) -> tuple[Any, ...]:
    """See hybridmap.recognising.algebra."""
    count = len(points)
    predicted, by_pose, by_point = predict(moved, inverted, optics, wanted, nearest)
    residuals, reprojection = np.zeros((count, 3)), np.empty((count, 2))
    information = np.zeros((count, 3, 3))
    distance2, ratios, weights = np.zeros(count), np.zeros(count), np.zeros(count)
    inliers = np.zeros(count, np.bool_)
    spread, root = np.empty((3, 3)), np.zeros((3, 3))
    inverse_root = np.zeros((3, 3))
    for n in range(count):
        j, p = by_point[n], covariances[n]
        visible = True
        for k in range(3):
            off = observed[n, k] - predicted[n, k]
            if k == 2 and not measured[n]:
                off = 0.0
            elif k < 2:
                reprojection[n, k] = off
                for m in range(3):
                    off -= j[k, m] * (points[n, m] - moved[n, m])
            else:
                for m in range(3):
                    off -= j[k, m] * (points[n, m] - moved[n, m])
            residuals[n, k] = off
            visible = visible and math.isfinite(off)
        if not visible:
            residuals[n], by_pose[n], by_point[n] = 0.0, 0.0, 0.0
        for row in range(3):
            for column in range(row + 1):
                value = noise[n, row] if row == column else 0.0
                for k in range(3):
                    for m in range(3):
                        value += j[row, k] * p[k, m] * j[column, m]
                spread[row, column] = value
        # Cholesky's root and its inverse: the depth's variance may be a million times the pixel's.
        root[0, 0] = math.sqrt(spread[0, 0])
        root[1, 0] = spread[1, 0] / root[0, 0]
        root[2, 0] = spread[2, 0] / root[0, 0]
        root[1, 1] = math.sqrt(spread[1, 1] - root[1, 0] ** 2)
        root[2, 1] = (spread[2, 1] - root[2, 0] * root[1, 0]) / root[1, 1]
        root[2, 2] = math.sqrt(spread[2, 2] - root[2, 0] ** 2 - root[2, 1] ** 2)
        i0, i1, i2 = 1.0 / root[0, 0], 1.0 / root[1, 1], 1.0 / root[2, 2]
        inverse_root[0, 0], inverse_root[1, 1], inverse_root[2, 2] = i0, i1, i2
        inverse_root[1, 0] = -root[1, 0] * i0 * i1
        inverse_root[2, 1] = -root[2, 1] * i1 * i2
        inverse_root[2, 0] = -(root[2, 0] * i0 + root[2, 1] * inverse_root[1, 0]) * i2
        for row in range(3):
            for column in range(3):
                value = 0.0
                for k in range(max(row, column), 3):
                    value += inverse_root[k, row] * inverse_root[k, column]
                information[n, row, column] = value
        value = 0.0
        for row in range(3):
            for column in range(3):
                value += residuals[n, row] * information[n, row, column] * residuals[n, column]
        distance2[n] = value
        log_determinant = -2.0 * (math.log(i0) + math.log(i1) + math.log(i2))
        ratios[n] = log_wrong[n] - 0.5 * (log_determinant + value)
        inliers[n] = visible and value < gates[n] and ratios[n] > 0
        if inliers[n]:
            weights[n] = 1.0 / (1.0 + math.exp(-min(ratios[n], 30.0)))
    return residuals, reprojection, by_pose, by_point, information, distance2, ratios, inliers, weights


@machine_code(f"Tuple(({MATRIX}, {VECTOR}))", MATRIX, CUBE, CUBE, VECTOR)
def normal_equations(
    residuals: Array, by_pose: Array, information: Array, weights: Array
) -> tuple[Array, Array]:
    """See hybridmap.recognising.algebra."""
    total, gradient, weighted = np.zeros((3, 3)), np.zeros(3), np.empty((3, 3))
    for n in range(len(weights)):
        if weights[n] == 0.0:
            continue
        for row in range(3):
            for column in range(3):
                value = 0.0
                for k in range(3):
                    value += by_pose[n, k, row] * information[n, k, column]
                weighted[row, column] = value * weights[n]
        for row in range(3):
            for k in range(3):
                gradient[row] += weighted[row, k] * residuals[n, k]
                for column in range(3):
                    total[row, column] += weighted[row, k] * by_pose[n, k, column]
    return total, gradient


@machine_code("boolean", MATRIX)
def determined(information: Array) -> bool:
    """See hybridmap.recognising.algebra."""
    if not np.isfinite(information).all():
        return False
    values = np.linalg.eigvalsh(information)
    return bool(values[0] > 1e-9 * max(values[2], 1e-300))


@machine_code("void", MATRIX, CUBE, MATRIX, CUBE, CUBE, CUBE, FLAGS, VECTOR, MATRIX)
def _move(
    points: Array,
    covariances: Array,
    residuals: Array,
    by_pose: Array,
    by_point: Array,
    information: Array,
    inliers: NDArray[np.bool_],
    step: Array,
    moved: Array,
) -> None:
    """Put the inliers' points at their best for this round, the others where they were given."""
    left, pulls = np.empty(3), np.empty(3)
    for n in range(len(points)):
        moved[n] = points[n]
        if not inliers[n]:
            continue
        for k in range(3):
            left[k] = residuals[n, k]
            for m in range(3):
                left[k] -= by_pose[n, k, m] * step[m]
        for k in range(3):
            pulls[k] = 0.0
            for m in range(3):
                for row in range(3):
                    pulls[k] += by_point[n, m, k] * information[n, m, row] * left[row]
        for k in range(3):
            for m in range(3):
                moved[n, k] += covariances[n, k, m] * pulls[m]


@machine_code(
    f"Tuple((boolean, {VECTOR}, {MATRIX}))", *_STACK, VECTOR, VECTOR, MATRIX, "int64", "float64", "float64"
)
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
    """See hybridmap.recognising.algebra."""
    pose, moved = start.copy(), points.copy()
    away = np.empty(3)
    for _ in range(rounds):
        residuals, _, by_pose, by_point, information, _, _, inliers, weights = linearise(
            points, covariances, observed, noise, measured, gates, log_wrong, inverted, optics,
            pose, moved, nearest,
        )  # fmt: skip
        total, gradient = normal_equations(residuals, by_pose, information, weights)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        dx, dy = prior[0] - pose[0], prior[1] - pose[1]
        away[0], away[1] = c * dx + s * dy, c * dy - s * dx
        away[2] = (prior[2] - pose[2] + math.pi) % (2.0 * math.pi) - math.pi
        for row in range(3):
            for k in range(3):
                total[row, k] += prior_information[row, k]
                gradient[row] += prior_information[row, k] * away[k]
        if not determined(total):
            return False, pose, moved
        step = np.linalg.solve(total, gradient)
        pose[0] += c * step[0] - s * step[1]
        pose[1] += s * step[0] + c * step[1]
        pose[2] = (pose[2] + step[2] + math.pi) % (2.0 * math.pi) - math.pi
        _move(points, covariances, residuals, by_pose, by_point, information, inliers, step, moved)
        if np.abs(step).max() < small_step:
            break
    return True, pose, moved
