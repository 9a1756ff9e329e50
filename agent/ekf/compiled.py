"""The products of agent.ekf.algebra as machine code, by numba: a third of the time for 30 landmarks.

No robot needs it: numba is the extra `fast`. Loops are written out and symmetry is used; the factorisation is
LAPACK's. Compiled once, then kept on disk beside this file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import lapack

from hybridmap.pose import Array

_MATRIX, _VECTOR, _SLOTS, _CUBE = "float64[:, ::1]", "float64[::1]", "intp[::1]", "float64[:, :, ::1]"


def _compiled(result: str, *arguments: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile for these types now, at import: a robot that drives must not wait for a compiler."""
    signature = f"{result}({', '.join(arguments)})"

    def made(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return _njit(signature, function, cache=True)
        except RuntimeError:
            # Nowhere to keep it: an installation that may not be written to, and no home either.
            return _njit(signature, function, cache=False)

    return made


def _njit(signature: str, function: Callable[..., Any], cache: bool) -> Callable[..., Any]:
    made: Callable[..., Any] = njit(signature, cache=cache, error_model="numpy")(function)
    return made


@_compiled("void", _MATRIX)
def _mirror(lower: Array) -> None:
    """Copy the lower triangle to the upper, in place, tile by tile as both sides must fit the cache."""
    size, tile = lower.shape[0], 16
    for top in range(0, size, tile):
        for left in range(0, top + tile, tile):
            for row in range(top, min(top + tile, size)):
                for k in range(left, min(left + tile, row)):
                    lower[k, row] = lower[row, k]


@_compiled(
    f"Tuple(({_VECTOR}, {_MATRIX}, {_VECTOR}, {_CUBE}, {_MATRIX}))", _VECTOR, _MATRIX, *["float64"] * 3
)
def transition(
    posture: Array, rays: Array, forward: float, turn: float, mount_forward: float
) -> tuple[Array, Array, Array, Array, Array]:
    """See agent.ekf.algebra."""
    n = rays.shape[0]
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
        block = blocks[i + 1]
        block[0, 0] = (c + s * a2) * q
        block[0, 2] = (c * ty - s * tx - d_w * a2) * q
        block[1, 0], block[1, 1], block[1, 2] = s * b2 * q, q, -d_w * b2 * q
        block[2, 0], block[2, 2] = s * w2 * q, (1.0 - d_w * w2) * q
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
    return posture_after, after, scale, blocks, by_input


@_compiled(_MATRIX, _MATRIX, _CUBE, _MATRIX, _MATRIX, "float64", _VECTOR)
def propagate(
    covariance: Array,
    transitions: Array,
    by_input: Array,
    wheel_root: Array,
    side_slip: float,
    variances: Array,
) -> Array:
    """See agent.ekf.algebra."""
    size, blocks = covariance.shape[0], transitions.shape[0]
    half = np.empty((size, size))
    out = np.empty((size, size))
    root = np.empty((size, 3))
    for i in range(size):
        root[i, 0] = by_input[i, 0] * wheel_root[0, 0] + by_input[i, 1] * wheel_root[1, 0]
        root[i, 1] = by_input[i, 0] * wheel_root[0, 1] + by_input[i, 1] * wheel_root[1, 1]
        root[i, 2] = by_input[i, 2] * side_slip
    for i in range(blocks):
        for r in range(3):
            t0, t1, t2 = transitions[i, r, 0], transitions[i, r, 1], transitions[i, r, 2]
            for k in range(size):
                half[3 * i + r, k] = (
                    t0 * covariance[3 * i, k] + t1 * covariance[3 * i + 1, k] + t2 * covariance[3 * i + 2, k]
                )
    for row in range(size):
        g0, g1, g2 = root[row, 0], root[row, 1], root[row, 2]
        for j in range(row // 3 + 1):
            h0, h1, h2 = half[row, 3 * j], half[row, 3 * j + 1], half[row, 3 * j + 2]
            for c in range(3):
                out[row, 3 * j + c] = (
                    h0 * transitions[j, c, 0] + h1 * transitions[j, c, 1] + h2 * transitions[j, c, 2]
                    + g0 * root[3 * j + c, 0] + g1 * root[3 * j + c, 1] + g2 * root[3 * j + c, 2]
                )  # fmt: skip
    for r in range(3):
        out[r, r] += variances[r]
    _mirror(out)
    return out


@_compiled(_MATRIX, _MATRIX, _SLOTS, _VECTOR)
def spread(covariance: Array, slots: NDArray[np.intp], variances: Array) -> Array:
    """See agent.ekf.algebra."""
    m = slots.shape[0]
    out = np.empty((2 * m, 2 * m))
    for i in range(m):
        row = 3 + 3 * slots[i]
        for j in range(m):
            column = 3 + 3 * slots[j]
            out[2 * i, 2 * j] = covariance[row, column]
            out[2 * i, 2 * j + 1] = covariance[row, column + 1]
            out[2 * i + 1, 2 * j] = covariance[row + 1, column]
            out[2 * i + 1, 2 * j + 1] = covariance[row + 1, column + 1]
        out[2 * i, 2 * i] += variances[0]
        out[2 * i + 1, 2 * i + 1] += variances[1]
    return out


def inverse(matrix: Array) -> Array:
    """See agent.ekf.algebra."""
    if not len(matrix):
        return matrix
    # The transpose is in LAPACK's order of storage already; being symmetric, it is the same matrix.
    root, failed = lapack.dpotrf(matrix.T, lower=0, clean=0)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the innovations is not positive definite")
    half, _ = lapack.dpotri(root, lower=0, overwrite_c=1)
    out: Array = half.T
    _mirror(out)
    return out


@_compiled(_VECTOR, _MATRIX, _MATRIX)
def leave_one_out(innovations: Array, information: Array) -> Array:
    """See agent.ekf.algebra."""
    m = innovations.shape[0]
    out = np.empty(m)
    for i in range(m):
        x, y = 0.0, 0.0
        for j in range(m):
            r0, r1 = innovations[j, 0], innovations[j, 1]
            x += information[2 * i, 2 * j] * r0 + information[2 * i, 2 * j + 1] * r1
            y += information[2 * i + 1, 2 * j] * r0 + information[2 * i + 1, 2 * j + 1] * r1
        p, q, r = information[2 * i, 2 * i], information[2 * i, 2 * i + 1], information[2 * i + 1, 2 * i + 1]
        out[i] = (r * x * x - 2.0 * q * x * y + p * y * y) / (p * r - q * q)
    return out


@_compiled(_SLOTS, _MATRIX)
def finite_rows(matrix: Array) -> NDArray[np.intp]:
    """See agent.ekf.algebra."""
    out, k = np.empty(len(matrix), np.intp), 0
    for i in range(len(matrix)):
        if np.isfinite(matrix[i, 0]) and np.isfinite(matrix[i, 1]):
            out[k] = i
            k += 1
    return out[:k]


@_compiled("boolean[::1]", _MATRIX, _VECTOR, "float64", "float64")
def ahead(rays: Array, scale: Array, nearest: float, widest_slope: float) -> NDArray[np.bool_]:
    """See agent.ekf.algebra."""
    out = np.empty(len(rays), np.bool_)
    for i in range(len(rays)):
        out[i] = rays[i, 2] * nearest <= 1.0 and scale[i] > 1e-3 and abs(rays[i, 0]) <= widest_slope
    return out


@_compiled(_MATRIX, _MATRIX, _SLOTS, _MATRIX, _VECTOR)
def pull(by_input: Array, slots: NDArray[np.intp], information: Array, residual: Array) -> Array:
    """See agent.ekf.algebra."""
    m2 = len(residual)
    known = np.empty((3, m2))
    for i in range(m2):
        row = 3 + 3 * slots[i // 2] + i % 2
        known[0, i], known[1, i], known[2, i] = by_input[row, 0], by_input[row, 1], residual[i]
    out = np.zeros((2, 3))
    for i in range(m2):
        first, second = 0.0, 0.0
        for j in range(m2):
            first += information[i, j] * known[0, j]
            second += information[i, j] * known[1, j]
        for c in range(3):
            out[0, c] += first * known[c, i]
            out[1, c] += second * known[c, i]
    return out


@_compiled(f"Tuple(({_VECTOR}, {_MATRIX}))", _MATRIX, _SLOTS, _MATRIX, _VECTOR, _VECTOR)
def condition(
    covariance: Array, slots: NDArray[np.intp], information: Array, variances: Array, residual: Array
) -> tuple[Array, Array]:
    """See agent.ekf.algebra.

    With M the measured entries, U the others and R the measurements' covariance, P_M - P_M S^-1 P_MM is
    P_M S^-1 R: no difference of what is nearly equal. Only P_UU - P_UM S^-1 P_MU remains to be multiplied.
    """
    size, m2 = covariance.shape[0], 2 * slots.shape[0]
    # Measured entries first, then the others.
    order, free = np.empty(size, np.intp), np.ones(size, np.bool_)
    for i in range(m2):
        order[i] = 3 + 3 * slots[i // 2] + i % 2
        free[order[i]] = False
    k = m2
    for i in range(size):
        if free[i]:
            order[k] = i
            k += 1
    columns = np.empty((size, m2))
    for i in range(size):
        row = covariance[order[i]]
        for j in range(m2):
            columns[i, j] = row[order[j]]
    gain = columns @ information
    taken = gain[m2:] @ columns[m2:].T
    step, out = np.empty(size), np.empty((size, size))
    # Row by row, each entry and its mirror by the same sum: symmetric to the last bit.
    for i in range(size):
        old, new, moved = covariance[order[i]], out[order[i]], 0.0
        for j in range(m2):
            moved += gain[i, j] * residual[j]
        step[order[i]] = moved
        if i < m2:
            noise = variances[i % 2]
            for j in range(m2):
                new[order[j]] = 0.5 * (gain[i, j] * variances[j % 2] + gain[j, i] * noise)
            for j in range(m2, size):
                new[order[j]] = gain[j, i] * noise
        else:
            for j in range(m2):
                new[order[j]] = gain[i, j] * variances[j % 2]
            for j in range(m2, size):
                new[order[j]] = old[order[j]] - 0.5 * (taken[i - m2, j - m2] + taken[j - m2, i - m2])
    return step, out
