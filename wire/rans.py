"""Many symbols at once, each for the bits that its frequency is worth: asymmetric numeral systems in lanes.

Each lane is a state in [2^m, 2^(m+1)) to which symbols are pushed and from which they come back last in,
first out (Duda, arXiv:1311.2540, the variant with ranges; side by side after Giesen, arXiv:1402.3392). A
symbol of frequency f of 2^12 costs 12 - log2(f) bits. What does not fit into the state any more goes to the
stream bit by bit; so a lane costs its m bits at the end and hardly half a bit more, and its first state may
hold m bits of something else. All lanes move together: a column is a few operations on arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.jit import compiled
from mapweave.hybridmap.landmark_tables import TOTAL_BITS

TOTAL = 1 << TOTAL_BITS
Ints = Annotated[NDArray[np.int64], 1]
Table = Annotated[NDArray[np.int64], 2]
Small = Annotated[NDArray[np.uint16], 2]
Bytes = Annotated[NDArray[np.uint8], 2]
Lanes = Ints | slice
EVERY = slice(None)
CUT_OFF = "landmarks: cut off"


def log2(numbers: Ints) -> Ints:
    """Whole part of the binary logarithm of numbers from 1."""
    return np.frexp(numbers)[1].astype(np.int64) - 1


class Columns(NamedTuple):
    """Columns of symbols that are read, or written, one after the other.

    What depends on the symbol alone is kept by symbol: so all of it stays in the processor's first cache.

    Attributes:
        symbols: (K, 4096) of each slot.
        frequencies: (K, S) of each symbol, with sum 2^12.
        starts: (K, S) sum of the frequencies before each symbol.
        missing: (K, S) bits that a state lacks at least after the symbol has been taken out of it.
    """

    symbols: Bytes
    frequencies: Small
    starts: Small
    missing: Small

    @staticmethod
    def of(frequencies: Table) -> Columns:
        """Columns of (K, S) frequencies, in the order of reading."""
        names = np.arange(frequencies.shape[1])
        missing = TOTAL_BITS - 1 - log2(np.maximum(frequencies, 1))
        return Columns(
            np.stack([np.repeat(names, of) for of in frequencies]).astype(np.uint8),
            frequencies.astype(np.uint16),
            (np.cumsum(frequencies, axis=1) - frequencies).astype(np.uint16),
            np.maximum(missing, 0).astype(np.uint16),
        )

    def part(self, first: int, last: int) -> Columns:
        """Those from first to last, that one left out."""
        some = slice(first, last)
        return Columns(self.symbols[some], self.frequencies[some], self.starts[some], self.missing[some])


def pop_columns(
    columns: Columns, windows: Ints, at: int, end: int, size: int, states: Ints, symbols: Bytes
) -> int:
    """Take one symbol out of each lane for each of K columns.

    Args:
        columns: to read.
        windows: of the bits, see BitReader.
        at: bit from which on it reads.
        end: bits that there are.
        size: m, of the lanes.
        states: (N,) of the lanes, changed.
        symbols: (K, N) is filled.

    Returns:
        The bit behind what it has read; beyond the end if there were not enough.
    """
    full = 1 << size
    for k in range(len(symbols)):
        slots = states & (TOTAL - 1)
        symbols[k] = columns.symbols[k][slots]
        left = columns.frequencies[k][symbols[k]] * (states >> TOTAL_BITS)
        left += slots - columns.starts[k][symbols[k]]
        bits = columns.missing[k][symbols[k]].astype(np.int64)
        bits += (left << bits) < full
        ends = np.cumsum(bits) + at
        if len(ends):
            at = ends[-1]
        if at > end:
            break
        begins = ends - bits
        states[:] = (left << bits) | (windows[begins >> 3] >> (40 - bits - (begins & 7)) & ((1 << bits) - 1))
    return at


@compiled
def push_columns(
    columns: Columns, size: int, symbols: Bytes, states: Ints, numbers: Table, widths: Table
) -> None:
    """Push one symbol to each lane for each of K columns, the last column first: `pop_columns` undone.

    Args:
        columns: to write.
        size: m, of the lanes.
        symbols: (K, N).
        states: (N,) of the lanes, changed.
        numbers: (K, N) is filled with the bits that leave the states, in the order of reading.
        widths: (K, N) is filled: how many bits.
    """
    for k in range(len(symbols) - 1, -1, -1):
        frequencies = columns.frequencies[k][symbols[k]].astype(np.int64)
        out = columns.missing[k][symbols[k]].astype(np.int64) + 1
        out -= (states >> out) < (frequencies << (size - TOTAL_BITS))
        numbers[k] = states & ((1 << out) - 1)
        widths[k] = out
        left = states >> out
        whole = left // frequencies
        states[:] = (whole << TOTAL_BITS) + columns.starts[k][symbols[k]] + left - whole * frequencies


@dataclass(eq=False)
class LaneWriter:
    """Lanes into which symbols go. What is pushed last is read first.

    Attributes:
        states: (N,) int64 in [2^m, 2^(m+1)).
        size: m, 12 to 32.
    """

    states: Ints
    size: int
    _bits: list[tuple[Ints, Ints]] = field(default_factory=list)

    def push(self, symbols: Bytes, columns: Columns, lanes: Lanes = EVERY) -> None:
        """(K, N) one symbol of each lane for each of K columns; none may be of frequency 0."""
        states = self.states[lanes]
        numbers, widths = np.empty(symbols.shape, np.int64), np.empty(symbols.shape, np.int64)
        push_columns(columns, self.size, np.ascontiguousarray(symbols), states, numbers, widths)
        self._bits.append((numbers.ravel(), widths.ravel()))
        self.states[lanes] = states

    def push_plain(self, numbers: Ints, widths: Ints, lanes: Lanes = EVERY) -> None:
        """A number of 0 to 12 bits for each lane, all equally likely."""
        left, states = TOTAL_BITS - widths, self.states[lanes]
        # A frequency of 2^left: the state is divided by shifting it.
        out = widths - ((states >> widths) < (1 << left + self.size - TOTAL_BITS))
        self._bits.append((states & ((1 << out) - 1), out))
        states >>= out
        self.states[lanes] = (states >> left << TOTAL_BITS) + (numbers << left) + (states & ((1 << left) - 1))

    def finish(self) -> tuple[Ints, Ints]:
        """Numbers and their widths in bits in the order of reading: last states, then the rest."""
        widths = np.full(len(self.states), self.size)
        parts = [(self.states - (1 << self.size), widths), *reversed(self._bits)]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


class LaneReader:
    """Lanes from which symbols come."""

    def __init__(self, bits: BitReader, count: int, size: int) -> None:
        """Read the last states of so many lanes of m bits."""
        self._bits, self._size = bits, size
        self.states = bits.read(np.full(count, size, np.int64)) + (1 << size)

    def pop(self, columns: Columns, lanes: Lanes = EVERY) -> Bytes:
        """(K, N) one symbol of each lane for each of K columns.

        Raises:
            InvalidMessage: there are not enough bits.
        """
        bits, states = self._bits, self.states[lanes]
        symbols = np.empty((len(columns.symbols), len(states)), np.uint8)
        bits.at = pop_columns(columns, bits.windows, bits.at, bits.length, self._size, states, symbols)
        if bits.at > bits.length:
            raise InvalidMessage(CUT_OFF)
        self.states[lanes] = states
        return symbols

    def pop_plain(self, widths: Ints, lanes: Lanes = EVERY) -> Ints:
        """A number of 0 to 12 bits of each lane."""
        states, left = self.states[lanes], TOTAL_BITS - widths
        slots = states & (TOTAL - 1)
        numbers = slots >> left
        states = ((states >> TOTAL_BITS) << left) + slots - (numbers << left)
        missing = self._size - log2(states)
        self.states[lanes] = (states << missing) | self._bits.read(missing)
        return numbers


class BitReader:
    """Numbers of so many bits each, first bit first.

    Attributes:
        windows: (N + 1,) int64, 40 bits from each byte on.
        length: bits that there are.
        at: the bit from which on it reads.
    """

    def __init__(self, data: bytes) -> None:
        self.at = 0
        padded = np.frombuffer(data + bytes(5), np.uint8).astype(np.int64)
        self.windows = np.zeros(len(data) + 1, np.int64)
        for k in range(5):
            self.windows |= padded[k : len(data) + 1 + k] << 8 * (4 - k)
        self.length = 8 * len(data)

    def read(self, widths: Ints) -> Ints:
        """Numbers of 0 to 32 bits.

        Raises:
            InvalidMessage: there are not that many.
        """
        ends = np.cumsum(widths) + self.at
        if len(ends) and ends[-1] > self.length:
            raise InvalidMessage(CUT_OFF)
        begins = ends - widths
        numbers: Ints = self.windows[begins >> 3] >> (40 - widths - (begins & 7)) & ((1 << widths) - 1)
        if len(ends):
            self.at = int(ends[-1])
        return numbers

    def end(self) -> None:
        """Nothing but the filling of the last byte may be left.

        Raises:
            InvalidMessage: there is more, or it is not zero.
        """
        left = self.length - self.at
        if left >= 8 or self.read(np.array([left])).any():
            raise InvalidMessage("landmarks: more than there should be")


def pack_bits(numbers: Ints, widths: Ints) -> bytes:
    """Numbers of 0 to 32 bits each, first bit first, filled with zeros to whole bytes."""
    ends = np.cumsum(widths)
    begins = ends - widths
    length = -(-int(ends[-1]) // 8) if len(ends) else 0
    # Each number covers five bytes from its first one; numbers that share a byte are added.
    moved, first = numbers << (40 - widths - (begins & 7)), begins >> 3
    packed = np.zeros(length + 5)
    for k in range(5):
        packed += np.bincount(first + k, moved >> 8 * (4 - k) & 255, length + 5)
    return packed[:length].astype(np.uint8).tobytes()
