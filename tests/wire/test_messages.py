"""Small messages and answers to questions come back as they were."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import (
    MAX_KNOWN,
    Certainty,
    KnownAnswer,
    KnownRequest,
    RelocalizeAnswer,
    RouteAnswer,
    RouteLeg,
    RouteRequest,
    View,
    Whereabouts,
)
from mapweave.wire.log_messages import (
    Ack,
    Head,
    KeptNodes,
    LogAnswer,
    LogRequest,
    Mark,
    NewestMap,
    Refusal,
    decode_record,
    encode_record,
)
from mapweave.wire.messages import decode, decode_view, encode, encode_view
from mapweave.wire.packing import pack

HERE = PoseGaussian.from_sigmas(Pose2(0.5, -0.25, 0.125), 0.5, 0.25)
scalars = st.one_of(
    st.booleans(),
    st.integers(-(2**53), 2**53),
    st.floats(-1e300, 1e300),
    st.text(st.characters(codec="ascii", categories=["L", "N", "P", "Zs"]), max_size=40),
)


def test_small_messages():
    for message in (
        Mark(7, 2**64 - 1),
        Head(2**63, 7, {"s0": 3, "s1": 7}),
        Head(0, 0),
        Ack(MapId("r0", 3), 5, 7, (Refusal(0, "the whole log"), Refusal(5, "of this"))),
        NewestMap(3),
        NewestMap(3, pruned=True),
        KeptNodes(3, (1, 2**53)),
        LogRequest(3, 3),
        LogAnswer(5, 3, 9, ((3, b"abc"), (5, b""), (9, b"x"))),
        LogAnswer(5, 3, 2, ()),
    ):
        assert type(message).decode(message.encode()) == message


@pytest.mark.parametrize(
    ("decode", "data"),
    [
        (Mark.decode, b"\0" * 16),
        (Mark.decode, b"\1" * 15),
        (KeptNodes.decode, KeptNodes(3, ()).encode()),
        (KeptNodes.decode, KeptNodes(3, tuple(range(2049))).encode()),
        (LogRequest.decode, pack({"f": 5, "q": 4})),
        (LogRequest.decode, LogRequest(0, 4).encode()),
        (LogAnswer.decode, pack({"l": 1, "f": 3, "q": 9, "c": [[4, b""], [4, b""]]})),
        (LogAnswer.decode, pack({"l": 1, "f": 3, "q": 9, "c": [[2, b""]]})),
        (LogAnswer.decode, pack({"l": 1, "f": 3, "q": 9, "c": [[10, b""]]})),
        (LogAnswer.decode, pack({"l": 1, "f": 3, "q": 1, "c": []})),
        (LogAnswer.decode, LogAnswer(1, 1, 300, tuple((k, b"") for k in range(1, 259))).encode()),
        (Head.decode, Head(1, -1).encode()),
        (Head.decode, Head(1, 1, {"S!": 1}).encode()),
        (Ack.decode, Ack(MapId("a/b", 1), 1, 1).encode()),
    ],
)
def test_nonsense_is_refused(decode: object, data: bytes):
    assert callable(decode)
    with pytest.raises(InvalidMessage):
        decode(data)


@pytest.mark.parametrize(("covered", "numbers"), [(9, [4, 4]), (9, [2]), (9, [10]), (1, [])])
def test_invalid_pieces_of_a_log_are_refused(covered: int, numbers: list[int]):
    with pytest.raises(InvalidValue):
        LogAnswer(1, 3, covered, tuple((number, b"") for number in numbers))
    with pytest.raises(InvalidValue):
        LogRequest(5, 4)


def test_only_the_newest_refusals_travel_and_none_is_too_long():
    ack = Ack(MapId("r0", 1), 1, 99, tuple(Refusal(k, "r" * 999) for k in range(1, 99)))
    back = Ack.decode(ack.encode())
    assert [refusal.sequence for refusal in back.refusals] == list(range(83, 99))
    assert {len(refusal.reason) for refusal in back.refusals} == {300}


@given(st.dictionaries(st.from_regex(r"[a-z_]{1,32}", fullmatch=True), scalars, max_size=20))
def test_records(values: dict[str, bool | int | float | str]):
    back = decode_record(encode_record(values))
    assert back == values
    assert [type(value) for value in back.values()] == [type(value) for value in values.values()]


@pytest.mark.parametrize(
    "values", [{"x": "a\nb"}, {"x": float("nan")}, {"x" * 33: 1}, {"x": 2**70}, {"x": b""}]
)
def test_records_that_cannot_be_sent(values: dict[str, object]):
    with pytest.raises(InvalidValue):
        encode_record(values)  # type: ignore[arg-type]


def test_a_view(some: SimpleNamespace):
    landmarks = some.node(120).landmarks
    encoded = encode_view(View(landmarks.pixels, landmarks.codes, some.camera))
    assert len(encoded) < 120 * 20
    back = decode_view(encoded)
    assert back.camera == some.camera
    assert np.array_equal(back.codes, landmarks.codes)
    assert np.abs(back.pixels - landmarks.pixels).max() <= 1 / 16
    assert encode_view(back) == encoded and back.near is None
    known = View(landmarks.pixels, landmarks.codes, some.camera, NodeId("r1", 1, 5))
    assert decode_view(encode_view(known)).near == known.near
    nowhere = pack({**msgspec.msgpack.decode(encoded), "near": ["R 1", 1, 5]})
    with pytest.raises(InvalidMessage, match="near"):
        decode_view(nowhere)


def test_a_view_that_cannot_be_sent(some: SimpleNamespace):
    landmarks = some.node(3).landmarks
    for pixels, codes in (
        (landmarks.pixels[:2], landmarks.codes),
        (landmarks.pixels, landmarks.codes.astype(np.int64)),
        (np.full((3, 2), np.nan, np.float32), landmarks.codes),
        (np.zeros((2001, 2), np.float32), np.zeros((2001, 32), np.uint8)),
    ):
        with pytest.raises(InvalidValue):
            encode_view(View(pixels, codes, some.camera))


def test_a_relocalization():
    places = (
        Whereabouts(NodeId("r1", 3, 17), HERE, HERE, 0, 41, 0.75),
        Whereabouts(NodeId("r2", 1, 4), HERE, None, -1, 12, 0.25),
    )
    encoded = encode(RelocalizeAnswer(Certainty.FOUND, places, "41 landmarks agree"))
    back = decode(encoded, RelocalizeAnswer)
    assert (back.certainty, back.reason) == (Certainty.FOUND, "41 landmarks agree")
    for new, old in zip(back.candidates, places, strict=True):
        assert (new.node, new.component, new.inliers) == (old.node, old.component, old.inliers)
        assert new.probability == old.probability
        assert new.node_from_robot.mean == HERE.mean
        assert np.array_equal(new.node_from_robot.covariance, HERE.covariance)
        assert (new.merged_from_robot is None) == (old.merged_from_robot is None)
    assert encode(back) == encoded
    nothing = RelocalizeAnswer(Certainty.UNKNOWN, (), "no node looks like it")
    same = decode(encode(nothing), RelocalizeAnswer)
    assert (same.certainty, same.candidates, same.reason) == (Certainty.UNKNOWN, (), nothing.reason)


def test_a_relocalization_that_cannot_be_sent():
    wrong = Whereabouts(NodeId("r1", 3, 17), HERE, HERE, 0, 41, 1.5)
    with pytest.raises(InvalidValue, match="probability"):
        encode(RelocalizeAnswer(Certainty.FOUND, (wrong,), ""))


def test_a_route(some: SimpleNamespace):
    start, goal = NodeId("r0", 1, 2), NodeId("r2", 1, 9)
    request = RouteRequest(start, goal, ((start, NodeId("r1", 1, 1)),), Pose2(0.1, 0.2, -3))
    assert decode(encode(request), RouteRequest) == request
    assert decode(encode(RouteRequest(request.start, request.goal)), RouteRequest).blocked == ()
    node = some.node(9)
    encoded = encode(
        RouteAnswer((RouteLeg(node, HERE, None), RouteLeg(node, HERE, EdgeKind.MERGED)), "2 nodes")
    )
    back = decode(encoded, RouteAnswer)
    assert [(leg.node.id, leg.kind) for leg in back.legs] == [(node.id, None), (node.id, EdgeKind.MERGED)]
    assert back.legs[1].previous_from_node.mean == HERE.mean
    assert encode(back) == encoded
    nothing = decode(encode(RouteAnswer((), "no way")), RouteAnswer)
    assert (nothing.legs, nothing.reason) == ((), "no way")


def test_the_cache_returns_its_entries():
    request = KnownRequest(MapId("r0", 3), 1.25, -2.5, 8.7)
    assert decode(encode(request), KnownRequest) == request
    views = np.random.default_rng(1).uniform([-50, -50, -3, 0.1], [50, 50, 3, 1.2], (MAX_KNOWN, 4))
    encoded = encode(KnownAnswer(views, "512 of 600 views"))
    assert len(encoded) < 16 * MAX_KNOWN + 64
    back = decode(encoded, KnownAnswer)
    assert np.allclose(back.views, views, atol=1e-5)
    assert back.reason == "512 of 600 views"
    assert encode(back) == encoded
    nothing = decode(encode(KnownAnswer(np.zeros((0, 4)), "unknown")), KnownAnswer)
    assert (nothing.views.shape, nothing.reason) == ((0, 4), "unknown")


@pytest.mark.parametrize(
    "view", [[np.nan, 0, 0, 0.5], [0, np.inf, 0, 0.5], [2e6, 0, 0, 0.5], [0, 0, 9, 0.5], [0, 0, 0, -0.1]]
)
def test_impossible_views_are_not_returned(view: list[float]):
    with pytest.raises(InvalidValue, match="out of range"):
        encode(KnownAnswer(np.array([view]), ""))


def test_more_than_the_announced_size_is_refused():
    with pytest.raises(InvalidValue, match="at most"):
        encode(KnownAnswer(np.zeros((MAX_KNOWN + 1, 4)), ""))
    with pytest.raises(InvalidValue, match="finite"):
        encode(KnownRequest(MapId("r0", 1), float("nan"), 0.0, 1.0))
