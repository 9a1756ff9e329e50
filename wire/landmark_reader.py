"""The bits of packed landmarks as whole numbers: in one pass where numba is installed, else lane by lane.

Both forms give the same numbers, and refuse the same with the same reason. The one in NumPy is what runs for
the first nodes, too (mapweave.hybridmap.jit): who reads a small map does not wait for numba.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.jit import compiled, compiled_form_of
from mapweave.hybridmap.landmark_tables import TOTAL_BITS, landmark_tables
from mapweave.hybridmap.node import CODE_BYTES
from mapweave.hybridmap.quantization import FINE_BITS
from mapweave.wire.rans import CUT_OFF, TOTAL, BitReader, Bytes, Columns, Ints, LaneReader

Row = Annotated[NDArray[np.uint8], 1]

OFF_THE_GRID = "landmarks: a pixel is out of range"
OTHER_ROWS = "landmarks: the rows are not those of {} landmarks"
TOO_LONG = "landmarks: more than there should be"
REASONS = ("", CUT_OFF, OTHER_ROWS, TOO_LONG, OFF_THE_GRID)
"""By what the compiled form returns."""
SHARES, CELLS = CODE_BYTES, CODE_BYTES + 1
"""Columns behind those of the codes: of the share and of the cell of a depth."""


class LandmarkHead(NamedTuple):
    """The head of packed landmarks, decoded.

    Attributes:
        landmarks: how many.
        size: bits of a lane.
        low: bits of y that a lane begins with.
        steps: of the row of high parts of y; -1 without a row.
        with_depths: 1 with depths, else 0.
        least_x: of the pixels.
        most_x: likewise.
        least_y: likewise.
        most_y: likewise.
    """

    landmarks: int
    size: int
    low: int
    steps: int
    with_depths: int
    least_x: int
    most_x: int
    least_y: int
    most_y: int


class Numbers(NamedTuple):
    """What is read, N of each: see mapweave.hybridmap.quantization.

    Attributes:
        x: (N,).
        y: (N,).
        share: (N,).
        depth: (N,).
        codes: (N, 32).
    """

    x: Ints
    y: Ints
    share: Ints
    depth: Ints
    codes: Bytes

    @staticmethod
    def zeros(count: int) -> Numbers:
        """Zeros for so many landmarks."""
        x, y, share, depth = np.zeros((4, count), np.int64)
        return Numbers(x, y, share, depth, np.zeros((count, CODE_BYTES), np.uint8))


@cache
def landmark_columns() -> Columns:
    """The columns of the fleet's tables in the order of reading: of the codes, of shares and of cells."""
    tables = landmark_tables()
    return Columns.of(np.concatenate([tables.codes, tables.shares[None], tables.cells[None]]))


def read_in_numpy(data: Row, layout: LandmarkHead, columns: Columns, fine: Ints, out: Numbers) -> int:
    """Read landmarks, a lane for each, side by side.

    Args:
        data: the bytes behind the head.
        layout: of the landmarks.
        columns: of the landmarks.
        fine: (64,) bits of a depth beside its cell, by the share.
        out: is filled.

    Returns:
        0.

    Raises:
        InvalidMessage: there is too little or too much, or a number is out of its range.
    """
    bits, high = BitReader(data.tobytes()), np.zeros(layout.landmarks, np.int64)
    if layout.steps >= 0:
        row = bits.read(np.ones(layout.landmarks + layout.steps if layout.landmarks else 0, np.int64))
        ones = np.flatnonzero(row)
        if len(ones) != layout.landmarks:
            raise InvalidMessage(OTHER_ROWS.format(layout.landmarks))
        high = ones - np.arange(layout.landmarks)
    lanes = LaneReader(bits, layout.landmarks, layout.size)
    out.codes[:] = lanes.pop(columns.part(0, SHARES)).T
    if layout.with_depths:
        out.share[:] = lanes.pop(columns.part(SHARES, CELLS))[0]
        known = np.flatnonzero(out.share)
        beside = fine[out.share[known]]
        cell = lanes.pop(columns.part(CELLS, CELLS + 1), known)[0].astype(np.int64)
        out.depth[known] = (cell << beside) | lanes.pop_plain(beside, known)
    bits.end()
    seeds = lanes.states - (1 << layout.size)
    out.x[:] = layout.least_x + (seeds >> layout.low)
    out.y[:] = layout.least_y + (high << layout.low | seeds & ((1 << layout.low) - 1))
    if out.x.max(initial=0) > layout.most_x or out.y.max(initial=0) > layout.most_y:
        raise InvalidMessage(OFF_THE_GRID)
    return 0


@compiled
def windows(data: Row) -> Ints:
    """40 bits from each byte on, and from behind the last one; beyond that 0."""
    out = np.empty(len(data) + 1, np.int64)
    bits: Any = 0
    for k in range(len(data) + 5):
        bits = (bits << 8 | (np.int64(data[k]) if k < len(data) else 0)) & 0xFFFFFFFFFF
        if k >= 4:
            out[k - 4] = bits
    return out


@compiled
def bits_at(window: Ints, at: int, width: int) -> int:
    """A number of 0 to 32 bits from a bit on."""
    number: int = window[at >> 3] >> (40 - width - (at & 7)) & ((1 << width) - 1)
    return number


@compiled
def pop(columns: Columns, k: int, states: Ints, symbols: Row, window: Ints, at: int, size: int) -> int:
    """Take a symbol of column k out of each lane; returns the bit behind what is read, or -1: cut off."""
    of_slot, frequencies = columns.symbols[k], columns.frequencies[k]
    starts, missing = columns.starts[k], columns.missing[k]
    end = 8 * (len(window) - 1)
    for n in range(len(states)):
        state = states[n]
        slot = state & (TOTAL - 1)
        symbol = of_slot[slot]
        left = np.int64(frequencies[symbol]) * (state >> TOTAL_BITS) + slot - np.int64(starts[symbol])
        bits: Any = np.int64(missing[symbol])
        bits += np.int64(left << bits < 1 << size)
        if at + bits > end:
            return -1
        states[n] = left << bits | bits_at(window, at, bits)
        at += bits
        symbols[n] = symbol
    return at


@compiled
def pop_depths(
    columns: Columns, fine: Ints, out: Numbers, states: Ints, window: Ints, at: int, size: int
) -> int:
    """Take shares and depths out of the lanes that have them, likewise."""
    symbols = np.empty(len(states), np.uint8)
    at = pop(columns, SHARES, states, symbols, window, at, size)
    if at < 0:
        return at
    out.share[:] = symbols
    known = np.flatnonzero(symbols)
    some = states[known]
    at = pop(columns, CELLS, some, symbols, window, at, size)
    if at < 0:
        return at
    for k in range(len(known)):
        n = known[k]
        # All steps within a cell are equally likely: as many bits come as leave the state.
        bits: Any = fine[out.share[n]]
        if at + bits > 8 * (len(window) - 1):
            return -1
        rest = TOTAL_BITS - bits
        slot = some[k] & (TOTAL - 1)
        out.depth[n] = np.int64(symbols[k]) << bits | slot >> rest
        left = (some[k] >> TOTAL_BITS << rest) + (slot & ((1 << rest) - 1))
        states[n] = left << bits | bits_at(window, at, bits)
        at += bits
    return at


@compiled_form_of(read_in_numpy)
def read_landmarks(data: Row, layout: LandmarkHead, columns: Columns, fine: Ints, out: Numbers) -> int:
    """Read landmarks in one pass; returns the number of the reason why they are refused, else 0."""
    at, length, count, size = 0, 8 * len(data), layout.landmarks, layout.size
    if layout.steps >= 0 and count:
        at = count + layout.steps
        if at > length:
            return 1
        ones = 0
        for k in range(at):
            if data[k >> 3] >> (7 - (k & 7)) & 1:
                if ones < count:
                    out.y[ones] = k - ones
                ones += 1
        if ones != count:
            return 2
    if at + count * size > length:
        return 1
    window = windows(data)
    states = np.empty(count, np.int64)
    for n in range(count):
        states[n] = (1 << size) + bits_at(window, at, size)
        at += size
    symbols = np.empty((CODE_BYTES, count), np.uint8)
    for k in range(CODE_BYTES):
        at = pop(columns, k, states, symbols[k], window, at, size)
        if at < 0:
            return 1
    out.codes[:] = symbols.T
    if layout.with_depths:
        at = pop_depths(columns, fine, out, states, window, at, size)
        if at < 0:
            return 1
    if length - at >= 8 or bits_at(window, at, length - at):
        return 3
    for n in range(count):
        seed = states[n] - (1 << size)
        out.x[n] = layout.least_x + (seed >> layout.low)
        out.y[n] = layout.least_y + (out.y[n] << layout.low | seed & ((1 << layout.low) - 1))
        if out.x[n] > layout.most_x or out.y[n] > layout.most_y:
            return 4
    return 0


def read(data: bytes, layout: LandmarkHead) -> Numbers:
    """Read what is behind the head of packed landmarks.

    Raises:
        InvalidMessage: there is too little or too much, or a number is out of its range.
    """
    out = Numbers.zeros(layout.landmarks)
    # Writable, as the compiled form wants it.
    row = np.frombuffer(bytearray(data), np.uint8)
    if reason := REASONS[read_landmarks(row, layout, landmark_columns(), FINE_BITS, out)]:
        raise InvalidMessage(reason.format(layout.landmarks))
    return out
