"""Map files: a whole map in one file that can be checked.

    magic    8 bytes   MAPWEAVE
    version  uint32    little-endian, like the next
    length   uint64    of the content
    content            MessagePack, see `_pack`
    digest   32 bytes  SHA-256 over everything before

Fields that an older program does not know it leaves alone; a file of an older program lacks them. The version
is raised only when an older program would misread a file.

Poses and landmarks have the wire's precision. A file is written under another name and then renamed, so
that a reader, or a loss of power, finds either the old file or the new one.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.node import Edge, NodeId
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.hybridmap.superseded import Superseded
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.wire.codec import MAX_BODY_BYTES, decode_body, encode_body
from mapweave.wire.history_codec import pack_happening, read_happenings
from mapweave.wire.landmark_codec import MAX_LANDMARKS
from mapweave.wire.manual_constraint_codec import pack_manual_constraint, read_manual_constraint
from mapweave.wire.packing import MAX_NUMBER, Reader, pack
from mapweave.wire.pose_codec import POSTURE, pack_pose, unpack_pose

MAGIC = b"MAPWEAVE"
VERSION = 1
HEADER = struct.Struct("<8sIQ")
DIGEST_BYTES = 32
MAX_CONTENT_BYTES = 2**32 - 1
MAX_ELEMENTS = 10_000_000
MAX_TITLE = 1000
MAX_REASON = 1024

Kind = Literal["agent", "merged"]


@dataclass(frozen=True, eq=False)
class RefusedPair:
    """Two similar nodes that were not linked.

    Attributes:
        a: one node.
        b: another one.
        reason: in words.
        edge: the refused link, or the robot's own edge; None if there is neither.
    """

    a: NodeId
    b: NodeId
    reason: str
    edge: Edge | None = None


@dataclass(frozen=True, eq=False)
class MapFile:
    """What is in a map file.

    Attributes:
        kind: one agent's own map, or the merged map of a fleet.
        title: one line for people.
        changes: the map is their replay; a merged map's links are edges among them.
        poses: of a merged map's nodes: number of the component, pose in that component's frame.
        refused: of a merged map: pairs that were not linked. Edges of robots that are refused are only here.
        rulings: manual constraints, in order.
        superseded: of a merged map: superseded nodes.
        faded: of a merged map: (N,) which of a node's N landmarks are faded.
        history: of a merged map: what has become of its maps by itself, in order.
    """

    kind: Kind
    title: str
    changes: tuple[ChangeBody, ...]
    poses: Mapping[NodeId, tuple[int, PoseGaussian]] = field(default_factory=dict)
    refused: tuple[RefusedPair, ...] = ()
    rulings: tuple[ManualConstraint, ...] = ()
    superseded: Mapping[NodeId, Superseded] = field(default_factory=dict)
    faded: Mapping[NodeId, NDArray[np.bool_]] = field(default_factory=dict)
    history: tuple[MapEvent, ...] = ()


def write_map_file(path: Path, content: MapFile) -> None:
    """Write a map file, all or nothing.

    Raises:
        InvalidValue: the content cannot be encoded.
        InvalidFile: the disk does not take it.
    """
    write_whole(path, pack_map_file(content))


def read_map_file(path: Path, kind: Kind | Literal["any"] = "any") -> MapFile:
    """Read and check a map file.

    Args:
        path: of the file.
        kind: refuse files of another kind.

    Raises:
        InvalidFile: it cannot be read, is truncated, altered or of another kind; one line gives the reason.
    """
    try:
        data = read_whole(path)
    except OSError as error:
        raise InvalidFile(f"{path}: cannot be read ({error.strerror})") from None
    try:
        content = unpack_map_file(data)
    except InvalidMessage as error:
        raise InvalidFile(f"{path}: {error}") from None
    if kind not in ("any", content.kind):
        raise InvalidFile(f"{path}: is a map file of kind {content.kind}, not {kind}")
    return content


def pack_map_file(content: MapFile) -> bytes:
    """The bytes of a map file.

    Raises:
        InvalidValue: the content cannot be encoded.
    """
    packed = _pack(content)
    data = HEADER.pack(MAGIC, VERSION, len(packed)) + packed
    data += hashlib.sha256(data).digest()
    try:
        # The title, the counts and the ids are checked by the reader.
        _unpack(packed)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data


def unpack_map_file(data: bytes) -> MapFile:
    """Check and decode the bytes of a map file.

    Raises:
        InvalidMessage: they are truncated, altered, or no map file.
    """
    if data[: len(MAGIC)] != MAGIC[: len(data)] or not data:
        raise InvalidMessage("is not a Mapweave map file")
    if len(data) < HEADER.size:
        raise InvalidMessage(f"is truncated: {len(data)} bytes, not even a header")
    _, version, length = HEADER.unpack_from(data)
    if version != VERSION:
        raise InvalidMessage(f"has format version {version}, this program reads {VERSION}")
    whole = HEADER.size + length + DIGEST_BYTES
    if len(data) < whole:
        raise InvalidMessage(f"is truncated: {len(data)} of {whole} bytes")
    if len(data) > whole:
        raise InvalidMessage(f"has {len(data) - whole} bytes too many")
    if hashlib.sha256(data[:-DIGEST_BYTES]).digest() != data[-DIGEST_BYTES:]:
        raise InvalidMessage("is damaged: its content does not match its checksum")
    return _unpack(data[HEADER.size : -DIGEST_BYTES])


def _pack(content: MapFile) -> bytes:
    poses = [[list(node), component, pack_pose(pose)] for node, (component, pose) in content.poses.items()]
    changes = [encode_body(change) for change in content.changes]
    fields = {"kind": content.kind, "title": content.title, "changes": changes, "poses": poses}
    refused = [
        [list(r.a), list(r.b), r.reason, b"" if r.edge is None else encode_body(EdgePut(r.edge))]
        for r in content.refused
    ]
    return pack(
        {
            **fields,
            "refused": refused,
            "rulings": [pack_manual_constraint(constraint) for constraint in content.rulings],
            "superseded": [
                [list(node), list(fate.by), fate.found, fate.distance, fate.turn]
                for node, fate in content.superseded.items()
            ],
            "faded": [
                [list(node), np.packbits(faded, bitorder="little").tobytes()]
                for node, faded in content.faded.items()
            ],
            "history": [pack_happening(event) for event in content.history],
        }
    )


def _unpack(content: bytes) -> MapFile:
    # A map file may have any number of values: the user has chosen to read it.
    reader = Reader(content, "map file", MAX_CONTENT_BYTES, MAX_CONTENT_BYTES)
    name = reader.text("kind", 16)
    kinds: dict[str, Kind] = {kind: kind for kind in get_args(Kind)}
    if name not in kinds:
        raise reader.error(f"kind {name!r} is unknown")
    changes = tuple(
        decode_body(reader.as_binary(change, "change", MAX_BODY_BYTES))
        for change in reader.array("changes", MAX_ELEMENTS)
    )
    poses: dict[NodeId, tuple[int, PoseGaussian]] = {}
    for value in reader.array("poses", MAX_ELEMENTS):
        parts = reader.as_array(value, "pose", 3)
        if len(parts) != 3:
            raise reader.error("a pose must be [node, component, pose]")
        pose = unpack_pose(reader.as_binary(parts[2], "pose", POSTURE.size))
        component = reader.as_integer(parts[1], "component", 0, MAX_NUMBER)
        poses[reader.as_node_id(parts[0], "node")] = (component, pose)
    refused = tuple(
        _read_refused(reader, value)
        for value in (reader.array("refused", MAX_ELEMENTS) if reader.has("refused") else [])
    )
    rulings = tuple(
        read_manual_constraint(reader, value)
        for value in (reader.array("rulings", MAX_ELEMENTS) if reader.has("rulings") else [])
    )
    superseded = dict(
        _read_superseded(reader, value)
        for value in (reader.array("superseded", MAX_ELEMENTS) if reader.has("superseded") else [])
    )
    sizes = {change.node.id: len(change.node.landmarks) for change in changes if isinstance(change, NodePut)}
    faded = dict(
        _read_faded(reader, value, sizes)
        for value in (reader.array("faded", MAX_ELEMENTS) if reader.has("faded") else [])
    )
    title = reader.text("title", MAX_TITLE)
    history = read_happenings(reader, "history") if reader.has("history") else ()
    return MapFile(kinds[name], title, changes, poses, refused, rulings, superseded, faded, history)


def _read_refused(reader: Reader, value: Any) -> RefusedPair:
    parts = reader.as_array(value, "refusal", 32)
    if len(parts) < 4:
        raise reader.error("a refusal must be [node, node, reason, edge]")
    a, b = (reader.as_node_id(part, "node") for part in parts[:2])
    reason, encoded = (
        reader.as_text(parts[2], "reason", MAX_REASON),
        reader.as_binary(parts[3], "edge", MAX_BODY_BYTES),
    )
    change = decode_body(encoded) if encoded else None
    if change is not None and not isinstance(change, EdgePut):
        raise reader.error("what was refused must be an edge")
    return RefusedPair(a, b, reason, None if change is None else change.edge)


def _read_superseded(reader: Reader, value: Any) -> tuple[NodeId, Superseded]:
    parts = reader.as_array(value, "superseded node", 32)
    if len(parts) < 5:
        raise reader.error("a superseded node must be [node, by, landmarks, distance, turn]")
    node, by = (reader.as_node_id(part, "node") for part in parts[:2])
    landmarks = reader.as_integer(parts[2], "landmarks", 0, MAX_NUMBER)
    distance, turn = (reader.as_number(part, "distance or turn", 0.0, 1e6) for part in parts[3:5])
    return node, Superseded(by, landmarks, distance, turn)


def _read_faded(reader: Reader, value: Any, sizes: Mapping[NodeId, int]) -> tuple[NodeId, NDArray[np.bool_]]:
    parts = reader.as_array(value, "faded landmarks", 32)
    if len(parts) < 2:
        raise reader.error("faded landmarks must be [node, bits]")
    node = reader.as_node_id(parts[0], "node")
    count = sizes.get(node)
    if count is None:
        raise reader.error(f"landmarks of {node} have faded, which is not there")
    bits = reader.as_binary(parts[1], "bits", MAX_LANDMARKS)
    if len(bits) != -(-count // 8):
        raise reader.error(f"{len(bits)} bytes of faded landmarks do not fit the {count} of {node}")
    packed = np.frombuffer(bits, np.uint8)
    return node, np.unpackbits(packed, count=count, bitorder="little").astype(np.bool_)
