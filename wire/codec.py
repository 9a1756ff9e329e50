"""Changes as bytes: what is kept on disks and sent over the wire. The layout stands in docs/wire.md.

A change is an envelope (sequence number, stamp) around a *body*. The body alone is what a map file holds. Ids
of the body's own map are written as a bare number, ids of other maps in full.

Encoding rounds (see mapweave.hybridmap.quantization), and brings variances and evidence within their bounds;
what was decoded encodes to the same bytes again.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, MapId, Node, NodeId, check_name
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import TrajectorySegment
from mapweave.wire.landmark_codec import MAX_LANDMARKS, MAX_LANDMARKS_BYTES, pack_landmarks, unpack_landmarks
from mapweave.wire.packing import MAX_NUMBER, MAX_STAMP_NS, Reader, pack
from mapweave.wire.pose_codec import MAX_MEASURED, pack_camera, pack_pose, unpack_camera, unpack_pose
from mapweave.wire.range_codec import MAX_RANGE_BYTES, pack_ranges, unpack_ranges
from mapweave.wire.trajectory_codec import MAX_WAKE_BYTES, pack_trajectory, unpack_trajectory

MAX_RADIUS_MM = 100_000
MAX_BODY_BYTES = MAX_LANDMARKS_BYTES + MAX_WAKE_BYTES + 2048
MAX_CHANGE_BYTES = MAX_BODY_BYTES + 256
MAX_SHARED = MAX_LANDMARKS
SINGLE = struct.Struct("<f")
NO_RANGES = Ranges()
NO_WAKE = TrajectorySegment()
MAX_EVIDENCE = 64
MOST_EVIDENCE = float(MAX_LANDMARKS)
"""Greatest number among the evidence: most are counts of landmarks or less. More says nothing more."""

NODE_PUT, NODE_RETIRED, EDGE_PUT, EDGE_RETIRED = 1, 2, 3, 4

EDGE_KINDS = {
    EdgeKind.MAPPED: 1,
    EdgeKind.TURNED: 2,
    EdgeKind.DRIVEN: 3,
    EdgeKind.LOOP: 4,
    EdgeKind.MERGED: 5,
}
KINDS_OF_EDGE = {number: kind for kind, number in EDGE_KINDS.items()}


def element_of(body: ChangeBody) -> NodeId:
    """The id of the node or edge that a body is about."""
    match body:
        case NodePut(node):
            return node.id
        case EdgePut(edge):
            return edge.id
        case NodeRetired(element) | EdgeRetired(element):
            return element


def encode_body(body: ChangeBody) -> bytes:
    """Encode a body.

    Raises:
        InvalidValue: it would not decode: too many landmarks, a number out of range.
    """
    element = element_of(body)
    head = {"i": list(element)}
    match body:
        case NodePut(node):
            data = pack({"k": NODE_PUT, **head, **_node_fields(node)})
        case EdgePut(edge):
            data = pack({"k": EDGE_PUT, **head, **_edge_fields(edge)}, single_floats=True)
        case NodeRetired():
            data = pack({"k": NODE_RETIRED, **head})
        case EdgeRetired():
            data = pack({"k": EDGE_RETIRED, **head})
    try:
        # One rule for both sides: what a receiver would refuse is not sent.
        decode_body(data)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data


def decode_body(data: bytes) -> ChangeBody:
    """Decode a body.

    Raises:
        InvalidMessage: anything is wrong with it.
    """
    reader = Reader(data, "change", MAX_BODY_BYTES)
    kind = reader.integer("k", NODE_PUT, EDGE_RETIRED)
    element = reader.node_id("i")
    if kind == NODE_PUT:
        return NodePut(_read_node(reader, element))
    if kind == EDGE_PUT:
        return EdgePut(_read_edge(reader, element))
    return NodeRetired(element) if kind == NODE_RETIRED else EdgeRetired(element)


def encode_change(change: Change) -> bytes:
    """Encode a change.

    Raises:
        InvalidValue: it would not decode, or its body belongs to another map.
    """
    if element_of(change.body).map != change.map:
        raise InvalidValue(f"a change of {change.map} cannot be about {element_of(change.body)}")
    return wrap_body(change.sequence, change.stamp_ns, encode_body(change.body))


def decode_change(data: bytes) -> Change:
    """Decode a change.

    Raises:
        InvalidMessage: anything is wrong with it.
    """
    sequence, stamp_ns, encoded = unwrap_body(data)
    body = decode_body(encoded)
    return Change(element_of(body).map, sequence, stamp_ns, body)


def wrap_body(sequence: int, stamp_ns: int, encoded: bytes) -> bytes:
    """The change's envelope around an encoded body.

    Raises:
        InvalidValue: a number is out of range.
    """
    if not (1 <= sequence <= MAX_NUMBER and 0 <= stamp_ns <= MAX_STAMP_NS):
        raise InvalidValue(f"change: sequence {sequence} or stamp {stamp_ns} is out of range")
    return pack({"q": sequence, "t": stamp_ns, "b": encoded})


def unwrap_body(data: bytes) -> tuple[int, int, bytes]:
    """Sequence number, stamp and the encoded body of a change; the body is not looked at.

    Raises:
        InvalidMessage: the envelope is broken.
    """
    reader = Reader(data, "change", MAX_CHANGE_BYTES)
    sequence = reader.integer("q", 1, MAX_NUMBER)
    return sequence, reader.integer("t", 0, MAX_STAMP_NS), reader.binary("b", MAX_BODY_BYTES)


def _node_fields(node: Node) -> dict[str, object]:
    fields: dict[str, object] = {
        "t": node.stamp_ns,
        "p": pack_pose(node.map_from_robot, MAX_MEASURED),
        "c": pack_camera(node.camera),
        "m": pack_landmarks(node.landmarks, node.camera),
    }
    if node.clock:
        fields["z"] = check_name(node.clock)
    if node.radius:
        fields["r"] = _millimetres(node.radius)
    if len(node.ranges):
        fields["g"] = pack_ranges(node.ranges)
    if len(node.wake):
        fields["u"] = pack_trajectory(node.wake, node.ranges.reach)
    return fields


def _millimetres(radius: float) -> int:
    if not 0.0 <= radius <= MAX_RADIUS_MM / 1000.0:
        raise InvalidValue(f"node: a robot's radius of {radius} m is out of range")
    return round(radius * 1000.0)


def _read_node(reader: Reader, element: NodeId) -> Node:
    camera = unpack_camera(reader.binary("c", MAX_BODY_BYTES))
    ranges = unpack_ranges(reader.binary("g", MAX_RANGE_BYTES)) if reader.has("g") else NO_RANGES
    return Node(
        id=element,
        stamp_ns=reader.integer("t", 0, MAX_STAMP_NS),
        map_from_robot=unpack_pose(reader.binary("p", MAX_BODY_BYTES), MAX_MEASURED),
        camera=camera,
        landmarks=_read_landmarks(reader, camera),
        clock=reader.name("z") if reader.has("z") else "",
        radius=reader.integer("r", 0, MAX_RADIUS_MM) / 1000.0 if reader.has("r") else 0.0,
        ranges=ranges,
        wake=unpack_trajectory(reader.binary("u", MAX_WAKE_BYTES), ranges) if reader.has("u") else NO_WAKE,
    )


def _read_landmarks(reader: Reader, camera: Camera) -> Landmarks:
    return unpack_landmarks(reader.binary("m", MAX_BODY_BYTES), camera)


def _edge_fields(edge: Edge) -> dict[str, object]:
    fields: dict[str, object] = {
        "a": _reference(edge.a, edge.id.map),
        "b": _reference(edge.b, edge.id.map),
        "p": pack_pose(edge.a_from_b, MAX_MEASURED),
        "w": EDGE_KINDS[edge.kind],
    }
    if len(edge.shared):
        fields["h"] = _pack_shared(edge.shared)
    if edge.evidence:
        fields["x"] = {name: _small(value) for name, value in edge.evidence.items()}
    return fields


def _read_edge(reader: Reader, element: NodeId) -> Edge:
    a, b = (_read_reference(reader, end, element.map) for end in "ab")
    if a == b:
        raise reader.error(f"edge {element} joins {a} to itself")
    evidence = reader.table("x", MAX_EVIDENCE) if reader.has("x") else {}
    return Edge(
        id=element,
        a=a,
        b=b,
        a_from_b=unpack_pose(reader.binary("p", MAX_BODY_BYTES), MAX_MEASURED),
        kind=KINDS_OF_EDGE[reader.integer("w", 1, len(EDGE_KINDS))],
        shared=_unpack_shared(reader.binary("h", 1 + 4 * MAX_SHARED) if reader.has("h") else b"\x01"),
        evidence={
            name: reader.as_number(value, name, 0.0, MOST_EVIDENCE) for name, value in evidence.items()
        },
    )


def _reference(element: NodeId, home: MapId) -> int | list[str | int]:
    return element.number if element.map == home else list(element)


def _read_reference(reader: Reader, name: str, home: MapId) -> NodeId:
    value = reader.any(name)
    if type(value) is int:
        return NodeId(*home, reader.integer(name, 0, MAX_NUMBER))
    return reader.node_id(name)


def _small(value: float) -> int | float:
    """A whole number packs into one to three bytes, another one, rounded to float32, into five."""
    if not math.isfinite(value):
        raise InvalidValue(f"edge: {value:g} in its evidence is no number")
    # Rounded first: what becomes whole by it must look the same when it is encoded again.
    (number,) = SINGLE.unpack(SINGLE.pack(min(max(value, 0.0), MOST_EVIDENCE)))
    return int(number) if number == int(number) else float(number)


def _pack_shared(shared: NDArray[Any]) -> bytes:
    """Bytes an index (1 or 2), then all indices in a, then all in b, little-endian."""
    pairs = np.asarray(shared)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.issubdtype(pairs.dtype, np.integer):
        raise InvalidValue(f"edge: shared landmarks need (K, 2) integers, not {pairs.shape} {pairs.dtype}")
    if len(pairs) > MAX_SHARED or pairs.min() < 0 or pairs.max() >= MAX_LANDMARKS:
        raise InvalidValue(f"edge: shared landmarks are too many or not in 0..{MAX_LANDMARKS - 1}")
    width = 1 if pairs.max() < 256 else 2
    return bytes([width]) + pairs.T.astype(f"<u{width}").tobytes()


def _unpack_shared(data: bytes) -> NDArray[np.int64]:
    width = data[0] if data else 0
    if width not in (1, 2) or (len(data) - 1) % (2 * width):
        raise InvalidMessage("edge: shared landmarks are no pairs of indices")
    pairs = np.frombuffer(data, f"<u{width}", offset=1).reshape(2, -1).T.astype(np.int64)
    if len(pairs) > MAX_SHARED or (pairs >= MAX_LANDMARKS).any():
        raise InvalidMessage(f"edge: shared landmarks are too many or not in 0..{MAX_LANDMARKS - 1}")
    return pairs
