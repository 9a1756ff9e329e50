"""What the wheels do to the mapping filter's state, as machine code (agent.ekf.compiled)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybridmap.machine_code import CUBE, MATRIX, VECTOR, machine_code
from hybridmap.pose import Array

_INPUT = "UniTuple(float64, 2)"


@machine_code(
    f"Tuple(({VECTOR}, {MATRIX}, {VECTOR}, {CUBE}, {MATRIX}))", VECTOR, MATRIX, _INPUT, _INPUT, "float64"
)
def transition(
    posture: Array, rays: Array, at: tuple[float, float], measured: tuple[float, float], mount_forward: float
) -> tuple[Array, Array, Array, Array, Array]:
    """See agent.ekf.algebra."""
    n = rays.shape[0]
    forward, turn = at
    c, s, ch, sh = math.cos(turn), math.sin(turn), math.cos(0.5 * turn), math.sin(0.5 * turn)
    tx, ty = forward * ch + mount_forward * (c - 1.0), forward * sh + mount_forward * s
    tx_turn = -0.5 * forward * sh - mount_forward * s
    ty_turn = 0.5 * forward * ch + mount_forward * c
    posture_after, after, scale = np.empty(3), np.empty((n, 3)), np.empty(n)
    blocks, by_input = np.zeros((n + 1, 3, 3)), np.empty((3 + 3 * n, 3))
    course_c, course_s = math.cos(posture[2] + 0.5 * turn), math.sin(posture[2] + 0.5 * turn)
    posture_after[0] = posture[0] + forward * course_c
    posture_after[1] = posture[1] + forward * course_s
    posture_after[2] = posture[2] + turn
    blocks[0, 0, 0] = blocks[0, 1, 1] = blocks[0, 2, 2] = 1.0
    blocks[0, 0, 2], blocks[0, 1, 2] = -forward * course_s, forward * course_c
    by_input[0, 0], by_input[0, 1] = course_c, -0.5 * forward * course_s
    by_input[1, 0], by_input[1, 1] = course_s, 0.5 * forward * course_c
    by_input[2, 0], by_input[2, 1] = 0.0, 1.0
    by_input[0, 2], by_input[1, 2], by_input[2, 2] = -course_s, course_c, 0.0
    for i in range(n):
        a, b, w = rays[i, 0], rays[i, 1], rays[i, 2]
        ahead, right = 1.0 - tx * w, a + ty * w
        d = c * ahead - s * right
        scale[i] = d
        q = 1.0 / (d if abs(d) > 1e-9 else 1e-9)
        a2, b2, w2 = (s * ahead + c * right) * q, b * q, w * q
        after[i, 0], after[i, 1], after[i, 2] = a2, b2, w2
        d_w = -c * tx - s * ty
        blocks[i + 1, 0, 0] = (c + s * a2) * q
        blocks[i + 1, 0, 2] = (c * ty - s * tx - d_w * a2) * q
        blocks[i + 1, 1, 0], blocks[i + 1, 1, 1], blocks[i + 1, 1, 2] = s * b2 * q, q, -d_w * b2 * q
        blocks[i + 1, 2, 0], blocks[i + 1, 2, 2] = s * w2 * q, (1.0 - d_w * w2) * q
        d_forward = -w * (c * ch + s * sh)
        d_turn = -w * (c * tx_turn + s * ty_turn) - (s * ahead + c * right)
        row = 3 + 3 * i
        by_input[row, 0] = (w * (c * sh - s * ch) - a2 * d_forward) * q
        by_input[row, 1] = (w * (c * ty_turn - s * tx_turn) + d - a2 * d_turn) * q
        by_input[row + 1, 0], by_input[row + 1, 1] = -b2 * d_forward * q, -b2 * d_turn * q
        by_input[row + 2, 0], by_input[row + 2, 1] = -w2 * d_forward * q, -w2 * d_turn * q
        d_aside = w * (c * sh - s * ch)
        by_input[row, 2] = (w * (s * sh + c * ch) - a2 * d_aside) * q
        by_input[row + 1, 2], by_input[row + 2, 2] = -b2 * d_aside * q, -w2 * d_aside * q
    more, further = measured[0] - forward, measured[1] - turn
    for k in range(3):
        posture_after[k] += by_input[k, 0] * more + by_input[k, 1] * further
    for i in range(n):
        for k in range(3):
            after[i, k] += by_input[3 + 3 * i + k, 0] * more + by_input[3 + 3 * i + k, 1] * further
    return posture_after, after, scale, blocks, by_input


@machine_code(MATRIX, MATRIX, CUBE, MATRIX, MATRIX, "float64", VECTOR)
def propagate(
    covariance: Array,
    transitions: Array,
    by_input: Array,
    wheel_root: Array,
    side_slip: float,
    variances: Array,
) -> Array:
    """See agent.ekf.algebra. Three rows of A P at a time; each entry and its mirror are one number."""
    size, blocks = covariance.shape[0], transitions.shape[0]
    root, out, half = np.empty((size, 3)), np.empty((size, size)), np.empty((3, size))
    for i in range(size):
        root[i, 0] = by_input[i, 0] * wheel_root[0, 0] + by_input[i, 1] * wheel_root[1, 0]
        root[i, 1] = by_input[i, 0] * wheel_root[0, 1] + by_input[i, 1] * wheel_root[1, 1]
        root[i, 2] = by_input[i, 2] * side_slip
    for i in range(blocks):
        for r in range(3):
            t0, t1, t2 = transitions[i, r, 0], transitions[i, r, 1], transitions[i, r, 2]
            for k in range(3 * i + 3):
                half[r, k] = (
                    t0 * covariance[3 * i, k] + t1 * covariance[3 * i + 1, k] + t2 * covariance[3 * i + 2, k]
                )
        for j in range(i + 1):
            for c in range(3):
                column, t0, t1, t2 = (
                    3 * j + c,
                    transitions[j, c, 0],
                    transitions[j, c, 1],
                    transitions[j, c, 2],
                )
                g0, g1, g2 = root[column, 0], root[column, 1], root[column, 2]
                for r in range(3):
                    row = 3 * i + r
                    entry = half[r, 3 * j] * t0 + half[r, 3 * j + 1] * t1 + half[r, 3 * j + 2] * t2
                    entry += root[row, 0] * g0 + root[row, 1] * g1 + root[row, 2] * g2
                    out[row, column] = entry
                    out[column, row] = entry
    for r in range(3):
        out[r, r] += variances[r]
    return out


@machine_code(
    f"Tuple(({VECTOR}, {MATRIX}, boolean[::1], intp))",
    VECTOR,
    MATRIX,
    _INPUT,
    "float64",
    "float64",
    "float64",
)
def drive(
    posture: Array,
    rays: Array,
    measured: tuple[float, float],
    mount_forward: float,
    nearest: float,
    widest_slope: float,
) -> tuple[Array, Array, NDArray[np.bool_], int]:
    """See agent.ekf.algebra_motion."""
    n = rays.shape[0]
    forward, turn = measured
    c, s, ch, sh = math.cos(turn), math.sin(turn), math.cos(0.5 * turn), math.sin(0.5 * turn)
    tx, ty = forward * ch + mount_forward * (c - 1.0), forward * sh + mount_forward * s
    moved, after, stays, gone = np.empty(3), np.empty((n, 3)), np.empty(n, np.bool_), 0
    moved[0] = posture[0] + forward * math.cos(posture[2] + 0.5 * turn)
    moved[1] = posture[1] + forward * math.sin(posture[2] + 0.5 * turn)
    moved[2] = posture[2] + turn
    for i in range(n):
        a, b, w = rays[i, 0], rays[i, 1], rays[i, 2]
        along, right = 1.0 - tx * w, a + ty * w
        d = c * along - s * right
        q = 1.0 / (d if abs(d) > 1e-9 else 1e-9)
        a, b, w = (s * along + c * right) * q, b * q, w * q
        after[i, 0], after[i, 1], after[i, 2] = a, b, w
        stays[i] = w * nearest <= 1.0 and d > 1e-3 and abs(a) <= widest_slope
        gone += not stays[i]
    return moved, after, stays, gone


@machine_code(
    f"Tuple(({VECTOR}, {MATRIX}, {MATRIX}, {MATRIX}))",
    VECTOR, MATRIX, MATRIX, _INPUT, _INPUT, "float64", MATRIX, "float64", VECTOR,
)  # fmt: skip
def advance(
    posture: Array,
    rays: Array,
    covariance: Array,
    at: tuple[float, float],
    measured: tuple[float, float],
    mount_forward: float,
    wheel_root: Array,
    side_slip: float,
    posture_variances: Array,
) -> tuple[Array, Array, Array, Array]:
    """See agent.ekf.algebra_motion."""
    moved, after, _, blocks, by_input = transition(posture, rays, at, measured, mount_forward)
    predicted = propagate(covariance, blocks, by_input, wheel_root, side_slip, posture_variances)
    return moved, after, by_input, predicted
