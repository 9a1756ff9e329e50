"""Values of any shape come back, and docs/wire.md names their fields."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.constraint_subject import Ends
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.packing import Limit
from mapweave.wire.typed import decode, encode, packed

LIMIT = Limit("sample", 10_000)


@dataclass(frozen=True)
class Inner:
    """A part."""

    name: str
    kind: EdgeKind | None = None


@dataclass(frozen=True)
class Sample:
    """One field of each sort."""

    count: Annotated[int, Meta(ge=0, le=9)]
    share: float
    which: Literal["one", "other"]
    node: NodeId
    inner: Inner | None = None
    inners: tuple[Inner, ...] = ()
    parts: tuple[frozenset[MapId], ...] = ()
    pose: Pose2 = field(default_factory=Pose2)
    ends: Ends | None = None
    events: tuple[MapEvent, ...] = ()
    numbers: dict[str, float] = field(default_factory=dict)
    inner_of: Mapping[NodeId, Inner] = field(default_factory=dict)


names = st.sampled_from(["a", "b9", "robot-0"])
ids = st.builds(NodeId, names, st.integers(0, 3), st.integers(0, 2**53))
maps = st.builds(MapId, names, st.integers(0, 3))
inners = st.builds(Inner, st.text("xyz ", max_size=5), st.none() | st.sampled_from(EdgeKind))
finite = st.floats(-1e6, 1e6)
samples = st.builds(
    Sample, st.integers(0, 9), finite, st.sampled_from(["one", "other"]), ids, st.none() | inners,
    st.lists(inners, max_size=3).map(tuple), st.lists(st.frozensets(maps, max_size=3), max_size=3).map(tuple),
    st.builds(Pose2, finite, finite, finite), st.none() | st.tuples(ids, ids) | st.tuples(maps, maps),
    st.lists(st.builds(MapEvent, st.integers(0, 9), st.sampled_from(MapEventKind), st.just("x"))).map(tuple),
    st.dictionaries(names, finite, max_size=3), st.dictionaries(ids, inners, max_size=3),
)  # fmt: skip
SAMPLE = Sample(1, 0.5, "one", NodeId("a", 1, 2))


@given(samples)
def test_values_come_back(sample: Sample):
    data = encode(sample, LIMIT)
    assert decode(data, Sample, LIMIT) == sample
    assert encode(decode(data, Sample, LIMIT), LIMIT) == data


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"count": 10}, "<= 9 - at `$.count`"),
        ({"count": 1.0}, "got `float` - at `$.count`"),
        ({"share": math.inf}, "not finite"),
        ({"share": True}, "got `bool` - at `$.share`"),
        ({"which": "third"}, "third"),
        ({"node": ["a", 1]}, "length 3, got 2 - at `$.node`"),
        ({"inner": {"name": 5}}, "`$.name` - at `$.inner`"),
        ({"inners": [{"name": "x"}, {}]}, "required field `name` - at `$.inners[1]`"),
        ({"inners": [{"name": "x", "kind": "flown"}]}, "flown"),
        ({"ends": [["a", 1], ["a", 1, 2]] * 2}, "length 2, got 4 - at `$.ends`"),
        ({"pose": [0.0, 0.0, 2e6]}, "`$[2]` - at `$.pose`"),
        ({"numbers": {"x": "1"}}, "got `str`"),
        ({"numbers": {"x\n": 1.0}}, "printable"),
        ({"inner_of": [[["a", 1, 2], {"name": 1}]]}, "at `$.inner_of`"),
        ({"inner_of": {"a": 1}}, "at `$.inner_of`"),
        ({"newer": "two\nlines"}, "printable"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(changed: dict[str, Any], reason: str):
    plain = {"v": 1, **packed(SAMPLE)}
    decode(msgpack.packb(plain), Sample, LIMIT)
    with pytest.raises(InvalidMessage) as refused:
        decode(msgpack.packb({**plain, **changed}), Sample, LIMIT)
    assert str(refused.value).startswith("sample: ") and reason in str(refused.value)
    assert "\n" not in str(refused.value)


def test_fields_with_defaults_may_be_missing_and_unknown_ones_are_ignored():
    plain = packed(SAMPLE)
    few = {name: plain[name] for name in ("count", "share", "which", "node")}
    assert decode(msgpack.packb({"v": 1, **few, "newer": [b"x"]}), Sample, LIMIT) == SAMPLE


@dataclass(frozen=True, eq=False)
class Arrays:
    """Of each kind."""

    doubles: NDArray[np.float64]
    singles: NDArray[np.float32]
    numbers: NDArray[np.int64]
    pixels: NDArray[np.uint8]
    flags: NDArray[np.bool_]


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 4), min_size=1, max_size=3))
def test_arrays_come_back(seed: int, shape: list[int]):
    numbers = np.random.default_rng(seed).normal(size=shape) * 1e3
    arrays = Arrays(
        numbers, numbers.astype(np.float32), numbers.astype(np.int64),
        numbers.astype(np.int64).astype(np.uint8),
        numbers > 0,
    )  # fmt: skip
    back = decode(encode(arrays, LIMIT), Arrays, LIMIT)
    for one in fields(Arrays):
        old, new = getattr(arrays, one.name), getattr(back, one.name)
        assert old.dtype == new.dtype and old.shape == new.shape and np.array_equal(old, new)
    with pytest.raises(InvalidValue, match="f8"):
        encode(Arrays(numbers, numbers, numbers, numbers, numbers), LIMIT)  # type: ignore[arg-type]
