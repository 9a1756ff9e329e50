"""Map files: a whole map in one file that can be checked.

    magic    8 bytes   MAPWEAVE
    version  uint32    little-endian, like the next
    length   uint64    of the content
    content            MessagePack, the fields of `MapFile`
    digest   32 bytes  SHA-256 over everything before

Fields that an older program does not know it leaves alone; a file of an older program lacks them. The version
is raised only when an older program would misread a file.

Poses and landmarks have the wire's precision. A file is written under another name and then renamed, so
that a reader, or a loss of power, finds either the old file or the new one.
"""

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.annotation import Annotation
from mapweave.hybridmap.change import ChangeBody, NodePut
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import Number, Words
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.hybridmap.superseded import Superseded
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.storage.file_format import what_to_do
from mapweave.storage.first_bytes import MAP_FILE
from mapweave.storage.os_errors import unreadable
from mapweave.wire.packing import Limit
from mapweave.wire.typed import decode, encode

MAGIC = MAP_FILE
VERSION = 1
HEADER = struct.Struct("<8sIQ")
DIGEST_BYTES = 32
"""Of SHA-256."""
# A map file may have any number of values: the user has chosen to read it.
LIMIT = Limit("map file", 2**32 - 1, 2**32 - 1)

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
    reason: Words
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
        constraints: manual constraints, in order.
        superseded: of a merged map: superseded nodes.
        faded: of a merged map: (N,) which of a node's N landmarks are faded.
        retired: of a merged map: retired nodes, and which of the constraints retires each, from 0; of retired
            maps none.
        history: of a merged map: what has become of its maps by itself, in order.
        annotations: what people say about the map, in order.
        images: PNG files of floor plans, by their SHA-256.
        refused_changes: maps of which a server refused a change, and why: they are implausible.
    """

    kind: Kind
    title: Annotated[str, Meta(max_length=1000)]
    changes: tuple[ChangeBody, ...]
    poses: Mapping[NodeId, tuple[Number, PoseGaussian]] = field(default_factory=dict)
    refused: tuple[RefusedPair, ...] = ()
    constraints: tuple[ManualConstraint, ...] = ()
    superseded: Mapping[NodeId, Superseded] = field(default_factory=dict)
    faded: Mapping[NodeId, NDArray[np.bool_]] = field(default_factory=dict)
    history: tuple[MapEvent, ...] = ()
    annotations: tuple[Annotation, ...] = ()
    retired: Mapping[NodeId, Number] = field(default_factory=dict)
    images: Mapping[str, bytes] = field(default_factory=dict)
    refused_changes: Mapping[MapId, Words] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse faded landmarks that the nodes do not have, and unknown constraints (InvalidValue)."""
        if any(number >= len(self.constraints) for number in self.retired.values()):
            raise InvalidValue("a node is retired by a constraint that is not there")
        if not self.faded:
            return
        sizes = {body.node.id: len(body.node.landmarks) for body in self.changes if isinstance(body, NodePut)}
        for node, flags in self.faded.items():
            if node not in sizes:
                raise InvalidValue(f"landmarks of {node} have faded, which is not there")
            if flags.shape != (sizes[node],):
                raise InvalidValue(f"faded landmarks of shape {flags.shape} do not fit node {node}")


def write_map_file(path: str | PathLike[str], content: MapFile) -> None:
    """Write a map file, all or nothing. It replaces a map file, and no other file.

    Raises:
        InvalidValue: the content cannot be encoded.
        InvalidFile: the disk does not take it, or a file that is no map is there.
    """
    write_whole(Path(path), pack_map_file(content))


def read_map_file(path: str | PathLike[str], kind: Kind | Literal["any"] = "any") -> MapFile:
    """Read and check a map file.

    Args:
        path: of the file.
        kind: refuse files of another kind.

    Raises:
        InvalidFile: it cannot be read, is truncated, altered or of another kind; one line gives the reason.
    """
    try:
        data = read_whole(Path(path))
    except OSError as error:
        raise unreadable(path, error) from None
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
    packed = encode(content, LIMIT)
    data = HEADER.pack(MAGIC, VERSION, len(packed)) + packed
    return data + hashlib.sha256(data).digest()


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
        advice = what_to_do(version, VERSION)
        raise InvalidMessage(f"has format version {version}, this program reads {VERSION}: {advice}")
    whole = HEADER.size + length + DIGEST_BYTES
    if len(data) < whole:
        raise InvalidMessage(f"is truncated: {len(data)} of {whole} bytes")
    if len(data) > whole:
        raise InvalidMessage(f"has {len(data) - whole} bytes too many")
    if hashlib.sha256(data[:-DIGEST_BYTES]).digest() != data[-DIGEST_BYTES:]:
        raise InvalidMessage("is damaged: its content does not match its checksum")
    return decode(data[HEADER.size : -DIGEST_BYTES], MapFile, LIMIT)
