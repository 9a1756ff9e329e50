"""The coder in lanes, against one lane in plain Python and against what information theory says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.wire.rans import (
    TOTAL,
    BitReader,
    Columns,
    Ints,
    LaneReader,
    LaneWriter,
    pack_bits,
)
from tests.hybridmap.kernel_forms import form

__all__ = ["form"]

pytestmark = pytest.mark.usefixtures("form")


def some_column(random: np.random.Generator, symbols: int) -> Ints:
    """Frequencies that sum to 2^12, some of them 1."""
    cuts = np.sort(random.choice(np.arange(1, TOTAL), symbols - 1, replace=False))
    return np.diff(np.concatenate([[0], cuts, [TOTAL]]))


def push(writer: LaneWriter, symbols: Ints, column: Ints) -> None:
    """One column."""
    writer.push(symbols.astype(np.uint8)[None], Columns.of(column[None]))


@given(st.integers(0, 2**32 - 1), st.integers(0, 30), st.integers(1, 12), st.integers(12, 18))
def test_pushed_symbols_come_back(seed: int, lanes: int, steps: int, size: int):
    random = np.random.default_rng(seed)
    columns = [some_column(random, int(random.integers(1, 60))) for _ in range(steps)]
    symbols = [random.integers(0, len(c), lanes) for c in columns]
    seeds = random.integers(0, 1 << size, lanes)
    some = np.flatnonzero(random.random(lanes) < 0.5)
    widths = random.integers(0, 13, len(some))
    plain = random.integers(0, 1 << widths)
    writer = LaneWriter(seeds + (1 << size), size)
    writer.push_plain(plain, widths, some)
    for column, row in zip(columns[::-1], symbols[::-1], strict=True):
        push(writer, row, column)
    data = pack_bits(*writer.finish())
    bits = BitReader(data)
    reader = LaneReader(bits, lanes, size)
    for column, row in zip(columns, symbols, strict=True):
        assert np.array_equal(reader.pop(Columns.of(column[None]))[0], row)
    assert np.array_equal(reader.pop_plain(widths, some), plain)
    assert np.array_equal(reader.states - (1 << size), seeds)
    bits.end()


@pytest.mark.parametrize("seed", range(20))
def test_many_columns_at_once_equal_one_by_one(seed: int):
    random = np.random.default_rng(seed)
    lanes, size = int(random.integers(0, 200)), int(random.integers(12, 32))
    alphabet = int(random.integers(1, 60))
    columns = [some_column(random, alphabet) for _ in range(9)]
    symbols = [random.integers(0, alphabet, lanes) for _ in columns]
    seeds = random.integers(0, 1 << size, lanes) + (1 << size)
    writer, at_once = LaneWriter(seeds.copy(), size), LaneWriter(seeds.copy(), size)
    for column, row in zip(columns[::-1], symbols[::-1], strict=True):
        push(writer, row, column)
    data = pack_bits(*writer.finish())
    at_once.push(np.array(symbols, np.uint8).reshape(9, lanes), Columns.of(np.array(columns)))
    assert pack_bits(*at_once.finish()) == data
    bits, other = BitReader(data), BitReader(data)
    reader, plain = LaneReader(bits, lanes, size), LaneReader(other, lanes, size)
    result = reader.pop(Columns.of(np.array(columns)))
    assert np.array_equal(result, np.concatenate([plain.pop(Columns.of(column[None])) for column in columns]))
    assert np.array_equal(result, np.array(symbols).reshape(9, lanes))
    assert np.array_equal(reader.states, plain.states) and bits.at == other.at
    if lanes > 10:
        short = BitReader(data[: -(-lanes * size // 8) + 1])
        with pytest.raises(InvalidMessage, match="cut off"):
            LaneReader(short, lanes, size).pop(Columns.of(np.array(columns)))


def test_a_symbol_costs_its_entropy():
    random = np.random.default_rng(1)
    shares = np.array([0.7, 0.15, 0.1, 0.04, 0.01])
    column = np.array([2867, 614, 410, 164, 41])
    assert column.sum() == TOTAL
    entropy = -(shares * np.log2(shares)).sum()
    lanes, steps = 100, 200
    writer = LaneWriter(np.full(lanes, 1 << 15), 15)
    for _ in range(steps):
        push(writer, random.choice(5, lanes, p=shares), column)
    bits = 8 * len(pack_bits(*writer.finish()))
    assert bits / (lanes * steps) == pytest.approx(entropy + 15 / steps, rel=0.01)


def test_one_rans_lane_in_plain_python():
    """The definition with whole numbers of any length and a string of bits."""
    random = np.random.default_rng(2)
    column, size = some_column(random, 20), 14
    symbols = random.integers(0, 20, 50)
    writer = LaneWriter(np.array([(1 << size) + 77]), size)
    for symbol in symbols[::-1]:
        push(writer, np.array([symbol]), column)
    text = "".join(f"{byte:08b}" for byte in pack_bits(*writer.finish()))
    state, text = (1 << size) + int(text[:size], 2), text[size:]
    for symbol in symbols:
        slot = state % TOTAL
        begin, count = 0, 0
        while begin + column[count] <= slot:
            begin += column[count]
            count += 1
        assert count == symbol
        state = int(column[count]) * (state // TOTAL) + slot - int(begin)
        while state < 1 << size:
            state, text = 2 * state + int(text[0]), text[1:]
    assert state == (1 << size) + 77
    assert len(text) < 8
    assert set(text) <= {"0"}


@given(st.lists(st.integers(0, 20).flatmap(lambda w: st.tuples(st.integers(0, (1 << w) - 1), st.just(w)))))
def test_bits(pairs: list[tuple[int, int]]):
    numbers, widths = (np.array([p[k] for p in pairs], np.int64) for k in (0, 1))
    data = pack_bits(numbers, widths)
    text = "".join(f"{n:0{w}b}" for n, w in pairs if w)
    assert data == int(text.ljust(8 * len(data), "0") or "0", 2).to_bytes(len(data), "big")
    reader = BitReader(data)
    assert reader.read(widths).tolist() == numbers.tolist()
    reader.end()
    with pytest.raises(InvalidMessage, match="cut off"):
        BitReader(data).read(np.append(widths, 8 * len(data) + 1 - widths.sum()).clip(0, 24).repeat(2))


def test_more_than_there_should_be_is_refused():
    for data in (b"\0", b"\1"):
        reader = BitReader(data)
        reader.read(np.array([0 if data == b"\0" else 4]))
        with pytest.raises(InvalidMessage, match="more than"):
            reader.end()
