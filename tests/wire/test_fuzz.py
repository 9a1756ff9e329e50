"""Any bytes from outside: only InvalidMessage is raised, and nothing huge is allocated."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import msgpack
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.constraint_subject import Apart, Linked
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.explanation import (
    FleetExplanation,
    LinkAgreement,
    MapsExplanation,
    Misfit,
    NearMiss,
    PairExplanation,
    Standing,
)
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint
from mapweave.hybridmap.node import EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import (
    Certainty,
    ExplainRequest,
    KnownAnswer,
    KnownRequest,
    RelocalizeAnswer,
    RouteAnswer,
    RouteLeg,
    RouteRequest,
    View,
    Whereabouts,
)
from mapweave.storage.map_file import MapFile, pack_map_file, unpack_map_file
from mapweave.wire import messages
from mapweave.wire.codec import decode_body, decode_change, encode_body, encode_change
from mapweave.wire.log_messages import (
    Ack,
    Head,
    KeptNodes,
    LogAnswer,
    LogRequest,
    Mark,
    Refusal,
    decode_record,
    encode_record,
)
from mapweave.wire.messages import decode_view, encode, encode_view
from mapweave.wire.packing import _exceeds
from mapweave.wire.pose_messages import MergedPose, PoseNews

Decoder = Callable[[bytes], object]


def one_of_each(some: SimpleNamespace) -> list[tuple[Decoder, bytes]]:
    """One good message for each decoder."""
    changes = [(decode_change, encode_change(change)) for change in some.changes()]
    here = PoseGaussian.from_sigmas(Pose2(0.1, 0.2, 0.3), 0.1, 0.1)
    node = some.node(20)
    view = View(node.landmarks.pixels, node.landmarks.codes, some.camera)
    places = (Whereabouts(node.id, here, here, -1, 20, 0.9), Whereabouts(node.id, here, None, 0, 12, 0.1))
    request = RouteRequest(node.id, NodeId("r1", 1, 1), ((node.id, node.id),), Pose2(1, 2, 3))
    legs = (RouteLeg(node, here, None), RouteLeg(node, here, EdgeKind.LOOP))
    return [
        *changes,
        (decode_body, encode_body(NodePut(some.node(5)))),
        (Mark.decode, Mark(7, 2**63).encode()),
        (Head.decode, Head(5, 7, {"s0": 3, "s1": 7}).encode()),
        (partial(PoseNews.decode, agent="r0"), poses(node, NodeId("r0", 4, 9)).encode("r0")),
        (Ack.decode, Ack(some.map, 5, 7, (Refusal(3, "because"), Refusal(5, "of this"))).encode()),
        (KeptNodes.decode, KeptNodes(3, (1, 2**53)).encode()),
        (LogRequest.decode, LogRequest(3, 200).encode()),
        (LogAnswer.decode, LogAnswer(5, 3, 6, ((3, b"abc"), (5, b""))).encode()),
        (decode_record, encode_record({"a": 1, "b": 0.5, "c": "text", "d": True})),
        (decode_view, encode_view(view)),
        (partial(messages.decode, kind=RelocalizeAnswer),
         encode(RelocalizeAnswer(Certainty.AMBIGUOUS, places, "why"))),
        (partial(messages.decode, kind=RouteRequest), encode(request)),
        (partial(messages.decode, kind=RouteAnswer), encode(RouteAnswer(legs, "why"))),
        (partial(messages.decode, kind=KnownRequest), encode(KnownRequest(some.map, 1.5, -2.5, 9.0))),
        (partial(messages.decode, kind=KnownAnswer), encode(KnownAnswer(np.ones((2, 4)), "why"))),
        (unpack_map_file, pack_map_file(MapFile("merged", "t", (NodePut(node),), {node.id: (0, here)}))),
        *explanations(some, node, here),
    ]  # fmt: skip


def poses(node: Node, gone: NodeId) -> PoseNews:
    """Of two maps in two frames, and one that is gone."""
    own, other = NodeId("r0", 3, 5), NodeId("r0", 4, 2)
    places = {own: MergedPose(own, Pose2(1, 2, 3)), other: MergedPose(node.id, Pose2(-1, 0.5, 0))}
    return PoseNews(2**63, 4, 5, places, (gone,))


def explanations(some: SimpleNamespace, a: Node, pose: PoseGaussian) -> list[tuple[Decoder, bytes]]:
    """Of two nodes and two maps, with the questions and manual constraints."""
    b, (one, two) = replace(a, id=NodeId("r1", 1, 1)), (a.id.map, MapId("r1", 1))
    constraint = ManualConstraint(Apart((a.id, b.id)), True, "anna", 5, "two kitchens")
    pairs = np.array([[1, 2], [3, 4]])
    by_hand = replace(constraint, about=Linked.of(a.id, b.id, pose, pairs, {"inliers": 12.0}))
    misfit = Misfit(pose, np.zeros(3), 1.5, False)
    link = LinkAgreement(a.id, b.id, 2.5, True, False)
    pair = PairExplanation(
        a, b, Standing.LINKED, "why", pairs, pairs[:1], np.array([0.5]), pose, {"inliers": 12.0}, 0.9,
        misfit, (link,), ("r0 says so",), (constraint,),
    )  # fmt: skip
    near = NearMiss(a.id, b.id, 5, 3, "too few")
    maps = MapsExplanation(one, two, False, "why", 0, 0, 3, 4, (near,), (constraint,), (one,))
    return [
        (partial(messages.decode, kind=PairExplanation), encode(pair)),
        (partial(messages.decode, kind=FleetExplanation), encode(FleetExplanation((maps,)))),
        (partial(messages.decode, kind=ExplainRequest), encode(ExplainRequest((one, two)))),
        (partial(messages.decode, kind=ManualConstraint), encode(constraint)),
        (partial(messages.decode, kind=ConstraintRequest), encode(ConstraintRequest(by_hand, True))),
    ]


def refused_or_read(decode: Decoder, data: bytes) -> None:
    try:
        decode(data)
    except InvalidMessage as error:
        assert str(error)
        assert "\n" not in str(error)


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
def test_garbage(some: SimpleNamespace, garbage: bytes) -> None:
    for decode, _ in messages_once(some):
        refused_or_read(decode, garbage)


@settings(max_examples=100)
@given(st.data())
def test_good_messages_gone_bad(some: SimpleNamespace, data: st.DataObject) -> None:
    decode, good = data.draw(st.sampled_from(messages_once(some)))
    decode(good)
    bad = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        # Most bytes are landmarks, which may be anything: aim at the structure in front as often.
        reach = data.draw(st.sampled_from([min(60, len(bad)), len(bad)]))
        bad[data.draw(st.integers(0, reach - 1))] ^= data.draw(st.integers(1, 255))
    refused_or_read(decode, bytes(bad))


def test_every_truncation_is_refused(some: SimpleNamespace) -> None:
    for decode, good in one_of_each(some):
        lengths = range(len(good)) if len(good) < 800 else np.linspace(0, len(good) - 1, 300).astype(int)
        for length in lengths:
            with pytest.raises(InvalidMessage):
                decode(good[:length])


def test_every_single_field_may_be_anything(some: SimpleNamespace) -> None:
    """Each field in turn is replaced by a value of each other kind."""
    anything = [
        None,
        True,
        -1,
        2**63,
        1.5,
        float("nan"),
        "x",
        "x" * 70000,
        b"",
        b"x",
        [],
        [[]],
        [None] * 3,
        {},
    ]
    for decode, good in one_of_each(some):
        if decode in (Mark.decode, unpack_map_file):
            continue
        fields = msgpack.unpackb(good)
        for name in fields:
            for value in anything:
                refused_or_read(decode, msgpack.packb({**fields, name: value}))


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
def test_a_claim_of_gigabytes_allocates_nothing(some: SimpleNamespace, bomb: bytes) -> None:
    tracemalloc.start()
    for decode, _ in messages_once(some):
        with pytest.raises(InvalidMessage):
            decode(bomb)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


SMALL = (b"\x90", b"\x80", b"\x91\x90", b"\xa0", b"\x01", b"\xc4\x00", b"\x81\xa0\x90")


@pytest.mark.parametrize("small", SMALL, ids=bytes.hex)
@pytest.mark.parametrize("outer", ["field", "unknown", "nested"])
def test_small_values_in_a_large_message_cost_no_memory(
    some: SimpleNamespace, small: bytes, outer: str
) -> None:
    """A message as long as its kind allows, full of the smallest values, is refused before they are made."""
    for decode, length in (
        (LogAnswer.decode, 31_000_000), (partial(messages.decode, kind=RouteAnswer), 8_000_000),
        (decode_change, 100_000), (partial(messages.decode, kind=RelocalizeAnswer), 36_000),
        (Head.decode, 65_000), (decode_record, 65_000),
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
def test_values_are_counted_as_they_are(value: object) -> None:
    def count(one: object) -> int:
        if isinstance(one, dict):
            return 1 + sum(1 + count(inner) for inner in one.values())
        return 1 + sum(map(count, one)) if isinstance(one, list) else 1

    data, values = msgpack.packb(value), count(value)
    assert not _exceeds(data, values)
    assert _exceeds(data, values - 1) or values == 1


def test_too_long_input_is_refused_before_decoding(some: SimpleNamespace) -> None:
    for decode in (decode_change, decode_body, decode_view, Head.decode, Ack.decode, decode_record):
        with pytest.raises(InvalidMessage, match="at most"):
            decode(b"\x80" + b"\0" * 200_000)


_once: list[tuple[Decoder, bytes]] = []


def messages_once(some: SimpleNamespace) -> list[tuple[Decoder, bytes]]:
    """Encoded once for all examples."""
    if not _once:
        _once.extend(one_of_each(some))
    return _once


def test_poses_come_back_as_they_were(some: SimpleNamespace) -> None:
    news = poses(some.node(3), NodeId("r0", 4, 9))
    assert PoseNews.decode(news.encode("r0"), "r0") == news
    with pytest.raises(InvalidMessage, match="r0's nodes, not of r1's"):
        PoseNews.decode(news.encode("r0"), "r1")
