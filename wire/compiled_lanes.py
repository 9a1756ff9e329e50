"""Lanes read as machine code; wire.lanes has the same in NumPy, where an operation on an array is a call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridmap.landmark_tables import TOTAL_BITS
from hybridmap.machine_code import machine_code

_SLOT = (1 << TOTAL_BITS) - 1
_SMALL = "uint16[:, ::1]"


@machine_code(
    "int64", "int64[::1]", "int64", "int64[::1]", "int64", "int64",
    _SMALL, _SMALL, _SMALL, "uint8[:, ::1]", "uint8[:, ::1]",
)  # fmt: skip
def pop_columns(
    states: NDArray[np.int64],
    size: int,
    windows: NDArray[np.int64],
    at: int,
    end: int,
    symbols: NDArray[np.uint16],
    widths: NDArray[np.uint16],
    places: NDArray[np.uint16],
    missing: NDArray[np.uint8],
    out: NDArray[np.uint8],
) -> int:
    """One symbol of each lane and column, see wire.lanes.LaneReader.pop.

    Args:
        states: (N,) of the lanes; changed.
        size: m, see wire.lanes.
        windows: (B,) of wire.lanes.BitReader.
        at: from which bit on.
        end: how many there are.
        symbols: (K, 4096) of each column's slots, see wire.lanes.Columns.
        widths: (K, 4096) likewise.
        places: (K, 4096) likewise.
        missing: (K, 4096) likewise.
        out: (K, N), is filled.

    Returns:
        The bit behind the last one that was read; -1 if there are not as many.
    """
    full = np.int64(1) << size
    for k in range(len(symbols)):
        for i in range(len(states)):
            slot = states[i] & _SLOT
            state = np.int64(widths[k, slot]) * (states[i] >> TOTAL_BITS) + np.int64(places[k, slot])
            bits = np.int64(missing[k, slot])
            bits += (state << bits) < full
            if at + bits > end:
                return -1
            read = windows[at >> 3] >> (40 - bits - (at & 7)) & ((np.int64(1) << bits) - 1)
            states[i] = state << bits | read
            out[k, i] = symbols[k, slot]
            at += bits
    return at
