"""The products of agent.ekf.algebra as machine code, by numba: a fifth of the time for 30 landmarks.

No robot needs it: numba is the extra `fast`. Loops are written out and symmetry is used; what is a product of
two whole matrices is left to BLAS. Inner loops begin at 0: from elsewhere the compiler would have to mind
negative indices, and would not use the processor's vectors.

Here is what an image does to the state; agent.ekf.compiled_motion has what the wheels do.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.ekf.compiled_motion import advance, drive, propagate, transition
from agent.ekf.landmarks import Ids
from hybridmap.machine_code import MATRIX, SLOTS, VECTOR, machine_code
from hybridmap.pose import Array

__all__ = [
    "advance", "condition", "drive", "examine", "glance", "innovations", "leave_one_out", "propagate",
    "sighted", "slots_of", "spread", "told", "transition", "vote", "wheel_errors", "whiten",
]  # fmt: skip

_IDS, _MASK = "int64[::1]", "boolean[::1]"
_TILE = 32
"""Rows and columns of G^T G that are multiplied at once: a few of the vectors that BLAS works with."""


@machine_code(SLOTS, _IDS, _IDS)
def slots_of(held: Ids, ids: Ids) -> NDArray[np.intp]:
    """See agent.ekf.algebra. Each search begins behind the last find: the two are mostly in one order."""
    n, slot = len(held), 0
    places = np.full(len(ids), -1, np.intp)
    for i in range(len(ids)):
        for _ in range(n):
            if slot == n:
                slot = 0
            slot += 1
            if held[slot - 1] == ids[i]:
                places[i] = slot - 1
                break
    return places


@machine_code(f"Tuple(({SLOTS}, {SLOTS}, {MATRIX}))", _IDS, _IDS, MATRIX, VECTOR, VECTOR)
def sighted(
    held: Ids, ids: Ids, pixels: Array, centre: Array, focal: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """See agent.ekf.algebra."""
    places = slots_of(held, ids)
    slots, rows = np.empty(len(ids), np.intp), np.empty(len(ids), np.intp)
    slopes, m = np.empty((len(ids), 2)), 0
    for i in range(len(ids)):
        if places[i] >= 0 and np.isfinite(pixels[i, 0]) and np.isfinite(pixels[i, 1]):
            slots[m], rows[m] = places[i], i
            slopes[m, 0] = (pixels[i, 0] - centre[0]) / focal[0]
            slopes[m, 1] = (pixels[i, 1] - centre[1]) / focal[1]
            m += 1
    return slots[:m], rows[:m], slopes[:m]


@machine_code(f"Tuple(({_MASK}, {MATRIX}))", "intp", SLOTS, _MASK, MATRIX, VECTOR)
def told(
    count: int, rows: NDArray[np.intp], believed: NDArray[np.bool_], innovations: Array, focal: Array
) -> tuple[NDArray[np.bool_], Array]:
    """See agent.ekf.algebra."""
    accepted, pixels = np.zeros(count, np.bool_), np.full((count, 2), np.nan)
    for i in range(len(rows)):
        accepted[rows[i]] = believed[i]
        pixels[rows[i], 0] = innovations[i, 0] * focal[0]
        pixels[rows[i], 1] = innovations[i, 1] * focal[1]
    return accepted, pixels


@machine_code(MATRIX, MATRIX, SLOTS, MATRIX)
def innovations(rays: Array, slots: NDArray[np.intp], slopes: Array) -> Array:
    """See agent.ekf.algebra."""
    out = np.empty((len(slots), 2))
    for i in range(len(slots)):
        out[i, 0] = slopes[i, 0] - rays[slots[i], 0]
        out[i, 1] = slopes[i, 1] - rays[slots[i], 1]
    return out


@machine_code("float64", MATRIX, SLOTS, MATRIX, MATRIX, "float64")
def vote(rays: Array, slots: NDArray[np.intp], slopes: Array, wheel_root: Array, most: float) -> float:
    """See agent.ekf.algebra."""
    m = len(slots)
    turns = np.empty(m)
    for i in range(m):
        a = rays[slots[i], 0]
        turns[i] = (slopes[i, 0] - a) / (1.0 + a * a)
    turns.sort()
    quarter = m // 4
    half = turns[quarter : m - quarter]
    variance = 1.2 * ((half[-1] - half[0]) / 1.35) ** 2 / m
    wheels = wheel_root[1, 0] ** 2 + wheel_root[1, 1] ** 2
    turn, limit = half.mean() * wheels / (wheels + variance), most * math.sqrt(wheels)
    return float(min(max(turn, -limit), limit))


@machine_code(MATRIX, MATRIX, SLOTS, VECTOR)
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


@machine_code(MATRIX, MATRIX)
def whiten(spread: Array) -> Array:
    """See agent.ekf.algebra. [S | 1] is eliminated to [L^T | L^-1].

    Two rows are taken off the rows below them at once, so that each of these is read and written half as
    often. Of a row only a window counts, from the pivot to the end of L^-1, which is as wide for every pivot.
    Its place is told by unsigned numbers: they cannot be negative, so that the compiler may use vectors.
    """
    n = spread.shape[0]
    width = (n + 9) // 8 * 8
    stride = n + width
    both = np.zeros((n, stride))
    for i in range(n):
        for k in range(n):
            both[i, k] = spread[i, k]
        both[i, n + i] = 1.0
    flat = both.ravel()
    for j in range(0, n, 2):
        last = min(j + 1, n - 1)
        one, other = np.uint64(j * stride + j), np.uint64(last * stride + j)
        for i in range(j, last + 1):
            row = np.uint64(i * stride + j)
            if i > j:
                above = both[j, i]
                for k in range(width):
                    flat[row + np.uint64(k)] -= above * flat[one + np.uint64(k)]
            if not both[i, i] > 0.0:
                raise np.linalg.LinAlgError("the covariance of the innovations is not positive definite")
            scale = 1.0 / math.sqrt(both[i, i])
            for k in range(width):
                flat[row + np.uint64(k)] *= scale
        for i in range(last + 1, n):
            first, second, row = both[j, i], both[last, i], np.uint64(i * stride + j)
            for k in range(width):
                here = np.uint64(k)
                flat[row + here] -= first * flat[one + here] + second * flat[other + here]
    return both[:, n : 2 * n].copy()


@machine_code(VECTOR, MATRIX, MATRIX)
def leave_one_out(innovations: Array, whitening: Array) -> Array:
    """See agent.ekf.algebra."""
    m = innovations.shape[0]
    pulled, out = (whitening @ innovations.ravel()) @ whitening, np.empty(m)
    for i in range(m):
        p, q, r = 0.0, 0.0, 0.0
        for j in range(2 * i, 2 * m):
            first, second = whitening[j, 2 * i], whitening[j, 2 * i + 1]
            p += first * first
            q += first * second
            r += second * second
        x, y = pulled[2 * i], pulled[2 * i + 1]
        out[i] = (r * x * x - 2.0 * q * x * y + p * y * y) / (p * r - q * q)
    return out


@machine_code(f"Tuple(({MATRIX}, {MATRIX}, float64, float64))", MATRIX, MATRIX, SLOTS, MATRIX, VECTOR)
def examine(
    rays: Array, covariance: Array, slots: NDArray[np.intp], slopes: Array, variances: Array
) -> tuple[Array, Array, float, float]:
    """See agent.ekf.algebra."""
    residual = innovations(rays, slots, slopes)
    whitening = whiten(spread(covariance, slots, variances))
    distances = leave_one_out(residual, whitening)
    distances.sort()
    return residual, whitening, distances[-1], distances[len(slots) // 2]


@machine_code(
    f"Tuple((float64, {VECTOR}, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, float64, float64))",
    VECTOR, MATRIX, MATRIX, "UniTuple(float64, 2)", "float64", MATRIX, "float64", VECTOR, MATRIX, SLOTS,
    MATRIX, VECTOR, "float64",
)  # fmt: skip
def glance(
    posture: Array,
    rays: Array,
    covariance: Array,
    measured: tuple[float, float],
    mount_forward: float,
    wheel_root: Array,
    side_slip: float,
    posture_variances: Array,
    expected: Array,
    slots: NDArray[np.intp],
    slopes: Array,
    variances: Array,
    most: float,
) -> tuple[float, Array, Array, Array, Array, Array, Array, float, float]:
    """See agent.ekf.algebra."""
    turn = measured[1] + vote(expected, slots, slopes, wheel_root, most)
    moved, after, by_input, predicted = advance(
        posture, rays, covariance, (measured[0], turn), measured, mount_forward, wheel_root, side_slip,
        posture_variances,
    )  # fmt: skip
    residual, whitening, worst, median = examine(after, predicted, slots, slopes, variances)
    return turn, moved, after, by_input, predicted, residual, whitening, worst, median


@machine_code("UniTuple(float64, 3)", MATRIX, MATRIX, SLOTS, MATRIX, MATRIX)
def wheel_errors(
    by_input: Array, wheel_root: Array, slots: NDArray[np.intp], whitening: Array, residual: Array
) -> tuple[float, float, float]:
    """See agent.ekf.algebra."""
    known = np.empty((2 * len(slots), 3))
    for i in range(2 * len(slots)):
        row = 3 + 3 * slots[i // 2] + i % 2
        known[i, 0] = by_input[row, 0] * wheel_root[0, 0] + by_input[row, 1] * wheel_root[1, 0]
        known[i, 1] = by_input[row, 0] * wheel_root[0, 1] + by_input[row, 1] * wheel_root[1, 1]
        known[i, 2] = residual[i // 2, i % 2]
    white = whitening @ known
    x = y = p = q = r = 0.0
    for i in range(len(white)):
        x += white[i, 0] * white[i, 2]
        y += white[i, 1] * white[i, 2]
        p += white[i, 0] * white[i, 0]
        q += white[i, 0] * white[i, 1]
        r += white[i, 1] * white[i, 1]
    forward, turn = wheel_root[0, 0] * x + wheel_root[0, 1] * y, wheel_root[1, 0] * x + wheel_root[1, 1] * y
    squares = max(r * x * x - 2.0 * q * x * y + p * y * y, 0.0) / max(p * r - q * q, 1e-300)
    return forward, turn, math.sqrt(squares)


@machine_code("void", VECTOR, VECTOR, MATRIX, "intp", "intp", "intp")
def _lessen(before: Array, after: Array, product: Array, size: int, top: int, left: int) -> None:
    """Take a tile of G^T G off P, (size^2,), and write what is left at its place and at its mirror's."""
    height, width = min(_TILE, size - top), min(_TILE, size - left)
    for i in range(height):
        start = np.uint64((top + i) * size + left)
        for k in range(width):
            here = start + np.uint64(k)
            after[here] = before[here] - product[i, k]
    for k in range(width):
        start = np.uint64((left + k) * size + top)
        for i in range(k + 1 if top == left else 0, height):
            after[start + np.uint64(i)] = after[(top + i) * size + left + k]


@machine_code(
    f"Tuple(({VECTOR}, {MATRIX}, {MATRIX}, float64))", VECTOR, MATRIX, MATRIX, SLOTS, MATRIX, MATRIX
)
def condition(
    posture: Array, rays: Array, covariance: Array, slots: NDArray[np.intp], whitening: Array, residual: Array
) -> tuple[Array, Array, Array, float]:
    """See agent.ekf.algebra. Of G^T G only tiles on the diagonal and left of it are multiplied."""
    size, m2 = covariance.shape[0], 2 * slots.shape[0]
    tiles = (size + _TILE - 1) // _TILE
    before, after = covariance.ravel(), np.empty(size * size)
    measured, root = np.zeros((m2, _TILE)), np.empty((tiles, m2, _TILE))
    white, step = whitening @ residual.ravel(), np.empty(tiles * _TILE)
    for t in range(tiles):
        left = t * _TILE
        width = min(_TILE, size - left)
        for i in range(m2):
            start = np.uint64((3 + 3 * slots[i // 2] + i % 2) * size + left)
            for k in range(width):
                measured[i, k] = before[start + np.uint64(k)]
            for k in range(width, _TILE):
                measured[i, k] = 0.0
        root[t] = whitening @ measured
        step[left : left + _TILE] = white @ root[t]
        for u in range(t + 1):
            _lessen(before, after, root[t].T @ root[u], size, left, u * _TILE)
    moved = step[:size]
    return (
        posture + moved[:3], rays + moved[3:].reshape(-1, 3), after.reshape(size, size), float(white @ white)
    )  # fmt: skip
