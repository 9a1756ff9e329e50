"""Any bytes from outside: only InvalidMessage is raised, and nothing huge is allocated."""

import json
import tracemalloc
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapweave.agent.drivers.messages import decode_description, decode_observation, decode_step
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.manual_constraint import ConstraintRequest
from mapweave.hybridmap.query import RelocalizeAnswer, RouteAnswer
from mapweave.storage.map_file import unpack_map_file
from mapweave.wire import messages
from mapweave.wire.codec import decode_body, decode_change
from mapweave.wire.log_messages import (
    Ack,
    Head,
    KeptNodes,
    LogAnswer,
    LogRequest,
    Mark,
    NewestMap,
    decode_record,
)
from mapweave.wire.messages import decode_view
from mapweave.wire.packing import _exceeds
from mapweave.wire.pose_messages import PoseNews

Decoder = Callable[[bytes], object]
DECODERS: dict[str, Decoder] = {
    "change": decode_change, "attachment": Mark.decode, "beacon": Head.decode, "acknowledgement": Ack.decode,
    "log question": LogRequest.decode, "log answer": LogAnswer.decode, "newest map": NewestMap.decode,
    "kept nodes": KeptNodes.decode, "merged poses": partial(PoseNews.decode, agent="r0"), "view": decode_view,
    "flat record": decode_record, "RobotDescription": decode_description, "step question": decode_step,
    "step answer": decode_observation, "map file": unpack_map_file,
    **{kind.__name__: partial(messages.decode, kind=kind) for kind in messages.LIMITS},
}  # fmt: skip
"""By what docs/wire_vectors.json calls a message."""
VECTORS = json.loads((Path(__file__).parents[2] / "docs" / "wire_vectors.json").read_text(encoding="utf-8"))
# Any bytes are a refusal: see test_refusal.py.
NAMED = [(one["what"], bytes.fromhex(one["hex"])) for one in VECTORS if one["what"] in DECODERS]
GOOD = [(DECODERS[what], data) for what, data in NAMED]
"""Good messages of every kind, with what reads them."""
GOOD.append((decode_body, msgpack.unpackb(GOOD[0][1])["b"]))
asked = messages.decode(dict(NAMED)["ConstraintRequest"], ConstraintRequest)
GOOD.append((DECODERS["ManualConstraint"], messages.encode(asked.constraint)))
EVERY = [decode_body, *map(DECODERS.__getitem__, dict(NAMED))]


def refused_or_read(decode: Decoder, data: bytes) -> object | None:
    try:
        return decode(data)
    except InvalidMessage as error:
        assert len(str(error).splitlines()) == 1
    return None


@given(garbage=st.binary(max_size=300))
@example(garbage=b"")
@example(garbage=b"\xc1")
@example(garbage=b"\x90" * 200)
@example(garbage=b"\x91" * 2000)
@example(garbage=b"\x81" * 2000)
@example(garbage=msgpack.packb({"v": 1, "b": msgpack.Timestamp(1, 1)}))
@example(garbage=b"\x81\xa1v\xd7\xff" + b"\xff" * 8)
@example(garbage=msgpack.packb({1: 1}))
@example(garbage=b"\x82\xa1v\x01\xa1k\xa2\xff\xff")
def test_garbage(garbage: bytes):
    for decode in EVERY:
        refused_or_read(decode, garbage)


@settings(max_examples=100)
@given(st.data())
def test_good_messages_gone_bad(data: st.DataObject):
    decode, good = data.draw(st.sampled_from(GOOD))
    decode(good)
    bad = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        # Most bytes are landmarks, which may be anything: aim at the structure in front as often.
        reach = data.draw(st.sampled_from([min(60, len(bad)), len(bad)]))
        bad[data.draw(st.integers(0, reach - 1))] ^= data.draw(st.integers(1, 255))
    refused_or_read(decode, bytes(bad))


def test_every_truncation_is_refused():
    for decode, good in GOOD:
        lengths = range(len(good)) if len(good) < 800 else np.linspace(0, len(good) - 1, 300).astype(int)
        for length in lengths:
            with pytest.raises(InvalidMessage):
                decode(good[:length])


ANYTHING = [
    None, True, -1, 2**63, 1.5, float("nan"), float("inf"), "x", "x" * 70000, "r0.².1", "r0.1." + "9" * 400,
    "..", b"", b"x", [], [[]], [None] * 3, {},
]  # fmt: skip


def altered(fields: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Each field in turn, and each of a map in it, is replaced by a value of each other kind."""
    for name, value in fields.items():
        yield from ({**fields, name: other} for other in ANYTHING)
        if isinstance(value, dict):
            yield from ({**fields, name: inner} for inner in altered(value))


def test_every_single_field_may_be_anything():
    """What is read all the same can be sent on."""
    for decode, good in GOOD:
        if decode in (Mark.decode, unpack_map_file):
            continue
        kind = decode.keywords.get("kind") if isinstance(decode, partial) else None
        for fields in altered(msgpack.unpackb(good)):
            value = refused_or_read(decode, msgpack.packb(fields))
            if value is not None and kind is not None:
                sent = messages.encode(value)
                assert messages.encode(messages.decode(sent, kind)) == sent


@pytest.mark.parametrize(
    "bomb",
    [
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
        b"\xc9\xff\xff\xff\xff\x01",
        b"\x81\xa1v\xdd\xff\xff\xff\xff",
        b"\x82\xa1v\x01\xa1b\xc6\x7f\xff\xff\xff",
        b"MAPWEAVE\x01\x00\x00\x00" + b"\xff" * 8,
    ],
)
def test_a_claim_of_gigabytes_allocates_nothing(bomb: bytes):
    tracemalloc.start()
    for decode in EVERY:
        with pytest.raises(InvalidMessage):
            decode(bomb)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


SMALL = (b"\x90", b"\x80", b"\x91\x90", b"\xa0", b"\x01", b"\xc4\x00", b"\x81\xa0\x90")


@pytest.mark.parametrize("small", SMALL, ids=bytes.hex)
@pytest.mark.parametrize("outer", ["field", "unknown", "nested"])
def test_small_values_in_a_large_message_cost_no_memory(small: bytes, outer: str):
    """A message as long as its kind allows, full of the smallest values, is refused before they are made."""
    # The shortest first: what makes the values of the longest takes minutes.
    for decode, length in (
        (partial(messages.decode, kind=RelocalizeAnswer), 36_000), (Head.decode, 65_000),
        (decode_record, 65_000), (decode_change, 100_000),
        (partial(messages.decode, kind=RouteAnswer), 8_000_000), (LogAnswer.decode, 31_000_000),
    ):  # fmt: skip
        count = length // len(small) - 10
        name = {"field": "c", "unknown": "zz", "nested": "w"}[outer].encode()
        bomb = b"\x82\xa1v\x01" + bytes([0xA0 + len(name)]) + name
        bomb += b"\x91\x91" if outer == "nested" else b""
        bomb += b"\xdd" + count.to_bytes(4, "big") + small * count
        tracemalloc.start()
        with pytest.raises(InvalidMessage, match="more than 4096 values"):
            decode(bomb)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 1_000_000


@given(st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
    | st.binary(max_size=300),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=40), inner, max_size=20),
    max_leaves=60,
))  # fmt: skip
def test_values_are_counted_as_they_are(value: object):
    def count(one: object) -> int:
        if isinstance(one, dict):
            return 1 + sum(1 + count(inner) for inner in one.values())
        return 1 + sum(map(count, one)) if isinstance(one, list) else 1

    data, values = msgpack.packb(value), count(value)
    assert not _exceeds(data, values)
    assert _exceeds(data, values - 1) or values == 1


def test_too_long_input_is_refused_before_decoding():
    for decode in (decode_change, decode_body, decode_view, Head.decode, Ack.decode, decode_record):
        with pytest.raises(InvalidMessage, match="at most"):
            decode(b"\x80" + b"\0" * 200_000)


def test_poses_of_another_robot_are_refused():
    data = dict(NAMED)["merged poses"]
    assert PoseNews.decode(data, "r0").encode("r0") == data
    with pytest.raises(InvalidMessage, match="r0's nodes, not of r1's"):
        PoseNews.decode(data, "r1")
