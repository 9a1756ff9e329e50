"""Changes as bytes: what is kept on disks and sent over the wire. The layout is in docs/wire.md.

A change is an envelope (sequence number, stamp) around a *body*. The body alone is what a map file holds. Ids
of the body's own map are written as a bare number, ids of other maps in full.

Encoding rounds (see mapweave.hybridmap.quantization), and brings variances and evidence within their bounds;
what was decoded encodes to the same bytes again.
"""

import math
import struct
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import MAX_LANDMARKS, MAX_NUMBER, MAX_STAMP_NS, Key, Name, Number, Stamp
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.ranges import NO_RANGES
from mapweave.hybridmap.trajectory_segment import NO_SEGMENT
from mapweave.wire.landmark_codec import MAX_LANDMARKS_BYTES, pack_landmarks, unpack_landmarks
from mapweave.wire.packing import Limit, pack, unpack
from mapweave.wire.pose_codec import MAX_MEASURED, pack_camera, pack_pose, unpack_camera, unpack_pose
from mapweave.wire.range_codec import pack_ranges, unpack_ranges
from mapweave.wire.trajectory_codec import MAX_SEGMENT_BYTES, pack_trajectory, unpack_trajectory

MAX_RADIUS_MM = 5000
"""mm. Of a footprint; a limit for messages."""
MAX_BODY_BYTES = MAX_LANDMARKS_BYTES + MAX_SEGMENT_BYTES + 2048
MAX_CHANGE_BYTES = MAX_BODY_BYTES + 256
BODY = Limit("change", MAX_BODY_BYTES)
CHANGE = Limit("change", MAX_CHANGE_BYTES)
MAX_SHARED = MAX_LANDMARKS
SINGLE = struct.Struct("<f")
MOST_EVIDENCE = float(MAX_LANDMARKS)
"""Greatest number among the evidence: most are counts of landmarks or less."""

EDGE_KINDS = {
    EdgeKind.MAPPED: 1,
    EdgeKind.TURNED: 2,
    EdgeKind.DRIVEN: 3,
    EdgeKind.LOOP: 4,
    EdgeKind.MERGED: 5,
}
KINDS_OF_EDGE = {number: kind for kind, number in EDGE_KINDS.items()}


class _Element(msgspec.Struct, tag_field="k", omit_defaults=True):
    id: NodeId = msgspec.field(name="i")


class _Kind(msgspec.Struct):
    kind: int = msgspec.field(name="k")


class _NodePut(_Element, tag=1):
    stamp_ns: Stamp = msgspec.field(name="t")
    map_from_robot: bytes = msgspec.field(name="p")
    camera: bytes = msgspec.field(name="c")
    landmarks: bytes = msgspec.field(name="m")
    clock: Name | None = msgspec.field(name="z", default=None)
    radius_mm: Annotated[int, Meta(ge=0, le=MAX_RADIUS_MM)] = msgspec.field(name="r", default=0)
    ranges: bytes | None = msgspec.field(name="g", default=None)
    segment: bytes | None = msgspec.field(name="u", default=None)


class _NodeRetired(_Element, tag=2):
    pass


class _EdgePut(_Element, tag=3):
    a: Number | NodeId
    b: Number | NodeId
    a_from_b: bytes = msgspec.field(name="p")
    kind: Annotated[int, Meta(ge=1, le=len(EDGE_KINDS))] = msgspec.field(name="w")
    shared: Annotated[bytes, Meta(max_length=1 + 4 * MAX_SHARED)] = msgspec.field(name="h", default=b"\x01")
    evidence: Annotated[dict[Key, Annotated[float, Meta(ge=0.0, le=MOST_EVIDENCE)]], Meta(max_length=64)] = (
        msgspec.field(name="x", default_factory=dict)
    )


class _EdgeRetired(_Element, tag=4):
    pass


class _Envelope(msgspec.Struct):
    sequence: Annotated[int, Meta(ge=1, le=MAX_NUMBER)] = msgspec.field(name="q")
    stamp_ns: Stamp = msgspec.field(name="t")
    body: Annotated[bytes, Meta(max_length=MAX_BODY_BYTES)] = msgspec.field(name="b")


def element_of(body: ChangeBody) -> NodeId:
    """The id of a body's node or edge."""
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
    match body:
        case NodePut(node):
            message: _Element = _node_message(node)
        case EdgePut(edge):
            message = _edge_message(edge)
        case NodeRetired(element):
            message = _NodeRetired(element)
        case EdgeRetired(element):
            message = _EdgeRetired(element)
    fields = msgspec.to_builtins(message, builtin_types=(bytes,))
    data = pack(fields, single_floats=True)
    try:
        # One rule for both sides: what a receiver would refuse is not sent. Landmarks that could be packed
        # are not unpacked, which would be a third of the work.
        _read(data, body.node.landmarks if isinstance(body, NodePut) else None)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data


def puts_node(body: bytes) -> bool:
    """Whether a body puts a node; quick, since nothing else of it is read.

    Raises:
        InvalidMessage: it is none.
    """
    try:
        return msgspec.msgpack.decode(body, type=_Kind).kind == _NodePut.__struct_config__.tag
    except msgspec.MsgspecError as error:
        raise InvalidMessage(f"change: {error}") from None


def decode_body(data: bytes) -> ChangeBody:
    """Decode a body.

    Raises:
        InvalidMessage: anything is wrong with it.
    """
    return _read(data)


def _read(data: bytes, landmarks: Landmarks | None = None) -> ChangeBody:
    """A body; with these landmarks, if they are known."""
    message = unpack(data, _NodePut | _NodeRetired | _EdgePut | _EdgeRetired, BODY)
    match message:
        case _NodePut():
            return NodePut(_read_node(message, landmarks))
        case _EdgePut():
            return EdgePut(_read_edge(message))
        case _NodeRetired():
            return NodeRetired(message.id)
        case _:
            return EdgeRetired(message.id)


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
    """Sequence number, stamp and the encoded body of a change; the body is not decoded.

    Raises:
        InvalidMessage: the envelope is broken.
    """
    envelope: _Envelope = unpack(data, _Envelope, CHANGE)
    return envelope.sequence, envelope.stamp_ns, envelope.body


def _node_message(node: Node) -> _NodePut:
    if not 0.0 <= node.radius <= MAX_RADIUS_MM / 1000.0:
        raise InvalidValue(f"node: a robot's radius of {node.radius} m is out of range")
    return _NodePut(
        node.id,
        node.stamp_ns,
        pack_pose(node.map_from_robot, MAX_MEASURED),
        pack_camera(node.camera),
        pack_landmarks(node.landmarks, node.camera),
        node.clock or None,
        round(node.radius * 1000.0),
        pack_ranges(node.ranges) if len(node.ranges) else None,
        pack_trajectory(node.segment, node.ranges.reach) if len(node.segment) else None,
    )


def _read_node(message: _NodePut, landmarks: Landmarks | None) -> Node:
    camera = unpack_camera(message.camera)
    ranges = NO_RANGES if message.ranges is None else unpack_ranges(message.ranges)
    return Node(
        message.id,
        message.stamp_ns,
        unpack_pose(message.map_from_robot, MAX_MEASURED),
        camera,
        unpack_landmarks(message.landmarks, camera) if landmarks is None else landmarks,
        message.clock or "",
        message.radius_mm / 1000.0,
        ranges,
        NO_SEGMENT if message.segment is None else unpack_trajectory(message.segment, ranges),
    )


def _edge_message(edge: Edge) -> _EdgePut:
    a, b = (end.number if end.map == edge.id.map else end for end in (edge.a, edge.b))
    message = _EdgePut(edge.id, a, b, pack_pose(edge.a_from_b, MAX_MEASURED), EDGE_KINDS[edge.kind])
    if len(edge.shared):
        message.shared = _pack_shared(edge.shared)
    message.evidence = {name: _small(value) for name, value in edge.evidence.items()}
    return message


def _read_edge(message: _EdgePut) -> Edge:
    a, b = (NodeId(*message.id.map, end) if isinstance(end, int) else end for end in (message.a, message.b))
    if a == b:
        raise InvalidMessage(f"change: edge {message.id} joins {a} to itself")
    return Edge(
        message.id,
        a,
        b,
        unpack_pose(message.a_from_b, MAX_MEASURED),
        KINDS_OF_EDGE[message.kind],
        _unpack_shared(message.shared),
        message.evidence,
    )


def _small(value: float) -> int | float:
    """A whole number packs into one to three bytes, another one, rounded to float32, into five."""
    if not math.isfinite(value):
        raise InvalidValue(f"edge: {value:g} in its evidence is no number")
    # Rounded first, so that the value encodes the same again.
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
