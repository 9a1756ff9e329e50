"""The codec: sizes, rounding and borders. Each layout is read by hand in test_vectors.py."""

import math
import struct
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import Change, EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.wire.codec import decode_body, decode_change, element_of, encode_body, encode_change

data = st.data()


def test_an_edge_of_60_shared_landmarks_is_small(some: SimpleNamespace):
    assert len(encode_change(Change(some.map, 1000, 2**62, EdgePut(some.edge())))) < 250


@given(data)
def test_encoding_a_decoded_value_gives_the_same_bytes(some: SimpleNamespace, data: st.DataObject):
    encoded = encode_body(data.draw(some.bodies))
    assert encode_body(decode_body(encoded)) == encoded


@given(data)
def test_a_node_keeps_its_content(some: SimpleNamespace, data: st.DataObject):
    node: Node = data.draw(some.nodes)
    body = decode_body(encode_body(NodePut(node)))
    assert isinstance(body, NodePut)
    back = body.node
    assert (back.id, back.stamp_ns, back.camera) == (node.id, node.stamp_ns, node.camera)
    assert (back.clock, back.radius, len(back.ranges)) == (node.clock, node.radius, len(node.ranges))
    assert np.abs(back.ranges.bearings - node.ranges.bearings).max(initial=0.0) <= 0.6e-4
    assert np.abs(back.ranges.distances - node.ranges.distances).max(initial=0.0) <= node.ranges.reach / 500
    nothing = node.ranges.distances >= node.ranges.reach
    assert (back.ranges.distances[nothing] == back.ranges.reach).all()
    assert np.abs(back.segment.ages - node.segment.ages).max(initial=0.0) <= 0.006
    assert np.abs(back.segment.node_from_robot - node.segment.node_from_robot).max(initial=0.0) <= 0.6e-3
    assert back.segment.distances.shape == node.segment.distances.shape
    assert np.abs(back.segment.distances - node.segment.distances).max(initial=0.0) <= node.ranges.reach / 500
    assert_close(back.map_from_robot, node.map_from_robot)
    old, new = node.landmarks, back.landmarks
    assert len(old) == len(new)
    assert np.array_equal(old.codes, new.codes)
    assert new.codes.flags.writeable
    if len(old):
        assert np.abs(old.pixels.astype(float) - new.pixels).max() <= 1 / 16 + 1e-9
    assert np.array_equal(old.has_depth, new.has_depth)
    known = old.has_depth
    np.testing.assert_allclose(
        new.depth_sigmas[known] / new.depths[known], old.depth_sigmas[known] / old.depths[known], rtol=0.065
    )
    most = np.maximum(old.depth_sigmas[known] / old.depths[known], 0.002) / 5.6
    assert (np.abs(np.log(new.depths[known].astype(float) / old.depths[known])) <= most).all()
    assert np.isnan(new.depth_sigmas[~known]).all()


NUMBERS = st.one_of(
    st.floats(width=32), st.floats(-2000.0, 4000.0, width=32), st.floats(0.0, 100.0, width=32)
)


@given(data)
def test_whatever_landmarks_are_encoded_can_be_decoded(some: SimpleNamespace, data: st.DataObject):
    """Encoding does not unpack them again to find that out."""
    count = data.draw(st.integers(0, 4))
    rows = st.lists(NUMBERS, min_size=count, max_size=count)
    columns = [np.array(data.draw(rows), np.float32) for _ in range(4)]
    codes = np.array(
        data.draw(st.lists(st.integers(0, 70), min_size=32 * count, max_size=32 * count)), np.uint8
    ).reshape(count, 32)
    landmarks = Landmarks(np.stack(columns[:2], axis=1), codes, *columns[2:])
    try:
        encoded = encode_body(NodePut(replace(some.node(), landmarks=landmarks)))
    except InvalidValue:
        return
    body = decode_body(encoded)
    assert isinstance(body, NodePut)
    assert np.array_equal(body.node.landmarks.codes, codes)


@given(data)
def test_an_edge_keeps_its_content(some: SimpleNamespace, data: st.DataObject):
    edge: Edge = data.draw(some.edges)
    body = decode_body(encode_body(EdgePut(edge)))
    assert isinstance(body, EdgePut)
    back = body.edge
    assert (back.id, back.a, back.b, back.kind) == (edge.id, edge.a, edge.b, edge.kind)
    assert_close(back.a_from_b, edge.a_from_b)
    assert np.array_equal(back.shared, edge.shared)
    assert back.shared.dtype == np.int64
    assert list(back.evidence) == list(edge.evidence)
    for name, value in edge.evidence.items():
        assert back.evidence[name] == pytest.approx(value, rel=1e-7, abs=1e-37)


@given(data)
def test_a_change_keeps_its_content(some: SimpleNamespace, data: st.DataObject):
    body = data.draw(some.bodies)
    map_id = element_of(body).map
    change = Change(map_id, data.draw(st.integers(1, 2**53)), data.draw(st.integers(0, 2**63 - 1)), body)
    back = decode_change(encode_change(change))
    assert (back.map, back.sequence, back.stamp_ns) == (change.map, change.sequence, change.stamp_ns)
    assert encode_body(back.body) == encode_body(body)


def assert_close(new: PoseGaussian, old: PoseGaussian) -> None:
    """Within float32, each covariance against the sigmas that it belongs to."""
    np.testing.assert_allclose(new.mean.vector, old.mean.vector, rtol=1e-7, atol=1e-30)
    np.testing.assert_allclose(new.covariance, old.covariance, rtol=1e-6, atol=1e-30)


def test_empty_values_cost_nothing_and_come_back_empty(some: SimpleNamespace):
    edge: Edge = some.edge(0)
    bare = Edge(edge.id, edge.a, edge.b, edge.a_from_b, edge.kind)
    encoded = encode_body(EdgePut(bare))
    assert len(encoded) < 80
    body = decode_body(encoded)
    assert isinstance(body, EdgePut)
    assert body.edge.shared.shape == (0, 2)
    assert body.edge.evidence == {}


@pytest.mark.parametrize("far", [0.009, 1.3e4, math.inf])
def test_depths_beyond_use_become_unknown(some: SimpleNamespace, far: float):
    back = through(some, depth=far, sigma=1.0)
    assert np.isnan(back.depths).all()
    assert np.isnan(back.depth_sigmas).all()


@pytest.mark.parametrize(("sigma", "share"), [(0.0, 0.002), (1e-9, 0.002), (1e4, 0.002 * math.exp(62 / 8))])
def test_sigmas_are_clipped(some: SimpleNamespace, sigma: float, share: float):
    back = through(some, depth=2.0, sigma=sigma)
    assert back.depth_sigmas[0] / back.depths[0] == pytest.approx(share, rel=1e-6)


def through(some: SimpleNamespace, depth: float, sigma: float) -> Landmarks:
    """One landmark, there and back."""
    landmarks = Landmarks(
        np.full((1, 2), 100, np.float32), np.zeros((1, 32), np.uint8),
        np.array([depth], np.float32), np.array([sigma], np.float32),
    )  # fmt: skip
    body = decode_body(encode_body(NodePut(replaced(some.node(), landmarks=landmarks))))
    assert isinstance(body, NodePut)
    return body.node.landmarks


def replaced(node: Node, **new: Any) -> Node:
    fields = {
        name: getattr(node, name) for name in ("id", "stamp_ns", "map_from_robot", "camera", "landmarks")
    }
    return Node(**{**fields, **new})


def bad_landmarks(count: int = 1, pixel: float = 10.0, depth: float = 1.0, sigma: float = 0.1) -> Landmarks:
    return Landmarks(
        np.full((count, 2), pixel, np.float32), np.zeros((count, 32), np.uint8),
        np.full(count, depth, np.float32), np.full(count, sigma, np.float32),
    )  # fmt: skip


@pytest.mark.parametrize(
    "new",
    [
        {"landmarks": bad_landmarks(2001)},
        {"landmarks": bad_landmarks(pixel=math.nan)},
        {"landmarks": bad_landmarks(pixel=1e6)},
        {"landmarks": bad_landmarks(pixel=-1e6)},
        {"landmarks": bad_landmarks(depth=0.0)},
        {"landmarks": bad_landmarks(depth=-1.0)},
        {"landmarks": bad_landmarks(sigma=math.nan)},
        {"landmarks": bad_landmarks(sigma=-0.1)},
        {"stamp_ns": -1},
        {"stamp_ns": 2**63},
        {"id": NodeId("r0", 1, -1)},
        {"id": NodeId("r0", -1, 1)},
        {"id": NodeId("R0!", 1, 1)},
        {"map_from_robot": PoseGaussian(Pose2(1.01e5, 0, 0), np.eye(3))},
        {"camera": Camera(320, 240, 1e300, 277, 160, 120, 0.2)},
    ],
)
def test_values_out_of_range_are_refused_before_sending(some: SimpleNamespace, new: dict[str, Any]):
    with pytest.raises(InvalidValue):
        encode_body(NodePut(replaced(some.node(), **new)))


def test_an_edge_that_cannot_be_sent_is_refused_before(some: SimpleNamespace):
    good: Edge = some.edge()

    def edge(**new: Any) -> EdgePut:
        names = ("id", "a", "b", "a_from_b", "kind", "shared", "evidence")
        return EdgePut(Edge(**{**{name: getattr(good, name) for name in names}, **new}))

    for new in (
        {"b": good.a},
        {"shared": np.array([[0, 2000]])},
        {"shared": np.array([[-1, 0]])},
        {"shared": np.array([0, 1])},
        {"shared": np.array([[0.5, 1.0]])},
        {"evidence": {"inliers": math.nan}},
        {"evidence": {"inliers": math.inf}},
        {"evidence": {"x" * 33: 1.0}},
        {"evidence": {f"x{k}": 1.0 for k in range(65)}},
    ):
        with pytest.raises(InvalidValue):
            encode_body(edge(**new))
    encode_body(edge())


@given(seed=st.integers(0, 2**32 - 1), largest=st.floats(4.01, 10.0))
def test_greater_variances_become_the_greatest(some: SimpleNamespace, seed: int, largest: float):
    """Directions stay, and what is known well stays so: NumPy's eigenvectors of what comes out."""
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    covariance = axes * [10.0**largest, 1e3, 1e4] @ axes.T
    body = NodePut(replaced(some.node(), map_from_robot=PoseGaussian(Pose2(), covariance)))
    encoded = encode_body(body)
    back = decode_body(encoded)
    assert isinstance(back, NodePut) and encode_body(back) == encoded
    expected = axes * [1e4, 1e3, 1e4] @ axes.T
    assert np.allclose(back.node.map_from_robot.covariance, expected, atol=0.02)
    nothing_known = replaced(some.node(), map_from_robot=PoseGaussian(Pose2(), 1e38 * axes @ axes.T))
    encode_body(NodePut(nothing_known))


def test_evidence_is_brought_within_its_bounds(some: SimpleNamespace):
    edge = replace(some.edge(), evidence={"inliers": 9e29, "there": -1.0, "rms_px": 0.5})
    back = decode_body(encode_body(EdgePut(edge)))
    assert isinstance(back, EdgePut)
    assert back.edge.evidence == {"inliers": 2000.0, "there": 0.0, "rms_px": 0.5}


def test_a_change_must_be_about_its_own_map(some: SimpleNamespace):
    with pytest.raises(InvalidValue, match="cannot be about"):
        encode_change(Change(MapId("other", 1), 1, 1, NodePut(some.node())))


@pytest.mark.parametrize(("sequence", "stamp_ns"), [(0, 0), (-1, 0), (2**54, 0), (1, -1), (1, 2**63)])
def test_numbers_of_a_change_are_bounded(sequence: int, stamp_ns: int):
    with pytest.raises(InvalidValue):
        encode_change(Change(MapId("r0", 1), sequence, stamp_ns, NodeRetired(NodeId("r0", 1, 1))))


FORGERIES: list[tuple[str, dict[str, Any], str]] = [
    ("node", {"v": 2}, "schema version 2"),
    ("node", {"v": True}, "schema version True"),
    ("node", {"k": 5}, r"Invalid value 5 - at `\$.k`"),
    ("node", {"k": "1"}, r"Expected `int`, got `str` - at `\$.k`"),
    ("node", {"i": ["robot-0", 3]}, r"length 3, got 2 - at `\$.i`"),
    ("node", {"i": ["Robot", 3, 1]}, r"`str` matching regex .* at `\$.i.0.`"),
    ("node", {"i": ["a/*", 3, 1]}, r"`str` matching regex .* at `\$.i.0.`"),
    ("node", {"i": ["r0", 3, 1.0]}, r"Expected `int`, got `float` - at `\$.i.2.`"),
    ("node", {"t": -1}, r"Expected `int` >= 0 - at `\$.t`"),
    ("node", {"p": struct.pack("<9f", math.nan, *[0] * 8)}, "not finite"),
    ("node", {"p": struct.pack("<9f", 0, 0, 0, math.inf, *[0] * 5)}, "not finite"),
    ("node", {"p": struct.pack("<9f", 0, 0, 0, -1, 0, 0, 1, 0, 1)}, "positive semi-definite"),
    ("node", {"p": struct.pack("<9f", 0, 0, 0, 1, 2, 0, 1, 0, 1)}, "positive semi-definite"),
    ("node", {"p": b"\0" * 35}, "35 bytes instead of 36"),
    ("node", {"c": struct.pack("<HH6d", 8, 240, 1, 1, 1, 1, 1, 1)}, "image size"),
    ("node", {"c": struct.pack("<HH6d", 320, 240, -1, 1, 1, 1, 1, 1)}, "focal"),
    ("node", {"c": struct.pack("<HH6d", 320, 240, math.nan, 1, 1, 1, 1, 1)}, "out of range"),
    ("node", {"m": b"\0" * 15}, "15 bytes are too few"),
    ("node", {"m": b"\2" + b"\0" * 20}, "version 2, this program reads 1"),
    ("node", {"m": b"\1" + b"\0" * 20}, "checksum"),
    ("node", {"m": "text"}, r"Expected `bytes`, got `str` - at `\$.m`"),
    ("edge", {"a": -1}, r"Expected `int` >= 0 - at `\$.a`"),
    ("edge", {"a": 17}, "to itself"),
    ("edge", {"a": ["robot-0", 3, 17]}, "to itself"),
    ("edge", {"a": None}, r"got `null` - at `\$.a`"),
    ("edge", {"w": 0}, r"Expected `int` >= 1 - at `\$.w`"),
    ("edge", {"h": b""}, "no pairs"),
    ("edge", {"h": b"\3\0\0"}, "no pairs"),
    ("edge", {"h": b"\1\0\0\0"}, "no pairs"),
    ("edge", {"h": b"\2\xff\xff\0\0"}, "not in 0..1999"),
    ("edge", {"x": {"inliers": "many"}}, r"Expected `float`, got `str` - at `\$.x"),
    ("edge", {"x": {"inliers": math.nan}}, "nan is not finite"),
    ("edge", {"x": {"a\nb": 1.0}}, "printable"),
    ("edge", {"x": [1]}, r"Expected `object`, got `array` - at `\$.x`"),
    ("edge", {"x": {"inliers": 9e29}}, r"Expected `float` <= 2000.0 - at `\$.x"),
    ("edge", {"x": {"inliers": -1.0}}, r"Expected `float` >= 0.0 - at `\$.x"),
    ("edge", {"p": struct.pack("<9f", 1.1e5, 0, 0, 1, 0, 0, 1, 0, 1)}, "further away than 100000 m"),
    ("node", {"p": struct.pack("<9f", 0, -1.1e5, 0, 1, 0, 0, 1, 0, 1)}, "further away than 100000 m"),
    ("edge", {"p": struct.pack("<9f", 0, 0, 0, 1e10, 0, 0, 0, 0, 0)}, "covariance is .* beyond 10000"),
    ("node", {"p": struct.pack("<9f", 0, 0, 0, *[6e3] * 6)}, "covariance is beyond 10000"),
]


@pytest.mark.parametrize(("kind", "forgery", "reason"), FORGERIES)
def test_forgeries_are_refused_with_a_reason(
    some: SimpleNamespace, kind: str, forgery: dict[str, Any], reason: str
):
    encoded = encode_body(NodePut(some.node(3)) if kind == "node" else EdgePut(some.edge(3)))
    fields = msgpack.unpackb(encoded)
    assert decode_body(msgpack.packb(fields))
    with pytest.raises(InvalidMessage, match=reason) as error:
        decode_body(msgpack.packb({**fields, **forgery}))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["v", "k", "i", "t", "p", "c", "m"])
def test_missing_parts_are_named(some: SimpleNamespace, name: str):
    fields = msgpack.unpackb(encode_body(NodePut(some.node(3))))
    del fields[name]
    with pytest.raises(InvalidMessage, match=f"required field `{name}`"):
        decode_body(msgpack.packb(fields))


def test_unknown_fields_are_ignored(some: SimpleNamespace):
    encoded = encode_body(NodePut(some.node(3)))
    newer = {"new": [1, {"deep": b"x"}], **msgpack.unpackb(encoded), "newer": None}
    assert encode_body(decode_body(msgpack.packb(newer))) == encoded


@settings(max_examples=30)
@given(data)
def test_any_view_of_a_camera_fits(some: SimpleNamespace, data: st.DataObject):
    """Every pixel from half an image outside on one side to half an image outside on the other."""
    camera: Camera = data.draw(some.cameras)
    far = np.array([[-0.5, -0.5], [1.5, 1.5], [1.5, -0.5]]) * [camera.width, camera.height]
    corners = Landmarks(
        np.trunc(far).astype(np.float32), np.zeros((3, 32), np.uint8),
        np.full(3, np.nan, np.float32), np.full(3, np.nan, np.float32),
    )  # fmt: skip
    body = decode_body(encode_body(NodePut(replaced(some.node(), camera=camera, landmarks=corners))))
    assert isinstance(body, NodePut)
    assert np.array_equal(body.node.landmarks.pixels, corners.pixels)
