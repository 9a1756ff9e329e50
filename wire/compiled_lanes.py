"""Landmarks read as machine code; wire.lanes has the parts in NumPy, an operation on an array a call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridmap.landmark_tables import TOTAL_BITS
from hybridmap.machine_code import machine_code

_SLOT = (1 << TOTAL_BITS) - 1
_SMALL = "uint16[:, ::1]"
_INTS = "int64[::1]"

FINE, CUT_OFF, WRONG_ROWS, LEFT_OVER = range(4)
"""What becomes of it."""


@machine_code("int64", _INTS, "int64", "int64")
def _read(windows: NDArray[np.int64], at: int, bits: int) -> int:
    found: int = windows[at >> 3] >> (40 - bits - (at & 7)) & ((np.int64(1) << bits) - 1)
    return found


@machine_code(
    "int64", "uint8[::1]", "int64", "int64", _SMALL, _SMALL, _SMALL, "uint8[:, ::1]", _INTS,
    _INTS, _INTS, "uint8[:, ::1]", _INTS, _INTS,
)  # fmt: skip
def unpack(
    data: NDArray[np.uint8],
    size: int,
    rows: int,
    symbols: NDArray[np.uint16],
    widths: NDArray[np.uint16],
    places: NDArray[np.uint16],
    missing: NDArray[np.uint8],
    fine_bits: NDArray[np.int64],
    high: NDArray[np.int64],
    states: NDArray[np.int64],
    codes: NDArray[np.uint8],
    share: NDArray[np.int64],
    depth: NDArray[np.int64],
) -> int:
    """Rows, lanes, codes, and depths if there is room for them, see wire.landmark_codec.

    Args:
        data: behind the head, and five bytes of 0.
        size: m, see wire.lanes.
        rows: bits of the row; 0 without one.
        symbols: (K + 2, 4096) of each column's slots, see wire.lanes.Columns: codes, share, cell.
        widths: (K + 2, 4096) likewise.
        places: (K + 2, 4096) likewise.
        missing: (K + 2, 4096) likewise.
        fine_bits: (64,) of the depth, by the share.
        high: (N,) is filled with the high parts of y.
        states: (N,) is filled with what the lanes began with, and 2^m.
        codes: (N, K) is filled.
        share: (N,) is filled, or none.
        depth: (N,) is filled, or none.

    Returns:
        FINE, or what is wrong.
    """
    count, columns, end = len(states), codes.shape[1], 8 * (len(data) - 5)
    windows = np.zeros(len(data) - 4, np.int64)
    for k in range(len(windows)):
        for part in range(5):
            windows[k] |= np.int64(data[k + part]) << 8 * (4 - part)
    at, found, full = np.int64(0), np.int64(0), np.int64(1) << size
    if rows > end:
        return CUT_OFF
    for k in range(rows):
        if _read(windows, at, 1):
            if found == count:
                return WRONG_ROWS
            high[found] = k - found
            found += 1
        at += 1
    if rows and found < count:
        return WRONG_ROWS
    if at + count * size > end:
        return CUT_OFF
    for i in range(count):
        states[i] = full + _read(windows, at, size)
        at += size
    for k in range(columns + 2 if len(share) else columns):
        for i in range(count):
            if k == columns + 1 and not share[i]:
                continue
            slot = states[i] & _SLOT
            state = np.int64(widths[k, slot]) * (states[i] >> TOTAL_BITS) + np.int64(places[k, slot])
            bits = np.int64(missing[k, slot])
            bits += (state << bits) < full
            if at + bits > end:
                return CUT_OFF
            states[i] = state << bits | _read(windows, at, bits)
            at += bits
            if k < columns:
                codes[i, k] = symbols[k, slot]
            elif k == columns:
                share[i] = symbols[k, slot]
            else:
                depth[i] = symbols[k, slot]
    for i in range(len(share)):
        if not share[i]:
            continue
        fine = fine_bits[share[i]]
        left = TOTAL_BITS - fine
        number = (states[i] & _SLOT) >> left
        state = (states[i] >> TOTAL_BITS << left) + (states[i] & _SLOT) - (number << left)
        bits = np.int64(0)
        while state << bits < full:
            bits += 1
        if at + bits > end:
            return CUT_OFF
        states[i] = state << bits | _read(windows, at, bits)
        at += bits
        depth[i] = depth[i] << fine | number
    if end - at >= 8 or _read(windows, at, end - at):
        return LEFT_OVER
    return FINE
