"""Which features are each other's nearest, as machine code: one way through a matrix of distances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridmap.machine_code import machine_code
from hybridmap.recognising.algebra import Nearest

_CODES = "uint8[:, ::1]"
_TABLE = "float32[:, ::1]"
_NEAREST = "Tuple((intp[::1], float32[::1], float32[::1]))"


@machine_code("int32[:, ::1]", _CODES, _CODES)
def squared_steps(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int32]:
    """See hybridmap.recognising.algebra.

    For so few features a matrix product takes longer: it wakes threads that a busy machine makes wait.
    """
    squared = np.empty((len(a), len(b)), np.int32)
    for i in range(len(a)):
        for j in range(len(b)):
            value = np.int32(0)
            for k in range(a.shape[1]):
                off = np.int32(a[i, k]) - np.int32(b[j, k])
                value += off * off
            squared[i, j] = value
    return squared


@machine_code(f"Tuple(({_NEAREST}, {_NEAREST}))", _TABLE)
def two_nearest(
    squared: NDArray[np.float32],
) -> tuple[Nearest, Nearest]:
    """See hybridmap.recognising.algebra."""
    rows, columns = squared.shape
    right, low = np.zeros(rows, np.intp), np.full(rows, np.inf, np.float32)
    next_low = np.full(rows, np.inf, np.float32)
    below, least = np.zeros(columns, np.intp), np.full(columns, np.inf, np.float32)
    next_least = np.full(columns, np.inf, np.float32)
    for i in range(rows):
        for j in range(columns):
            value = squared[i, j]
            if value < low[i]:
                next_low[i], low[i], right[i] = low[i], value, j
            elif value < next_low[i]:
                next_low[i] = value
            if value < least[j]:
                next_least[j], least[j], below[j] = least[j], value, i
            elif value < next_least[j]:
                next_least[j] = value
    return (right, low, next_low), (below, least, next_least)
