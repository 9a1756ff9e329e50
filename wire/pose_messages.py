"""What a server tells an agent of where its nodes lie in the merged map, as bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.node import NodeId, check_name
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.packing import MAX_NUMBER, Reader, pack
from mapweave.wire.pose_codec import MAX_POSITION

MAX_POSTURES = 1 << 18
"""Nodes of one agent in one message."""
MAX_GROUPS = 1 << 16
MAX_BYTES = 32 * MAX_POSTURES
NUMBERS = np.dtype("<f4")
PLACE_BYTES = 3 * NUMBERS.itemsize


@dataclass(frozen=True, slots=True)
class MergedPose:
    """Where a node lies in the merged map.

    Attributes:
        frame: names the component: its smallest node, in whose map's frame the component lies.
        merged_from_node: in that frame.
    """

    frame: NodeId
    merged_from_node: Pose2


@dataclass(frozen=True)
class PoseNews:
    """What has become of an agent's nodes.

    Attributes:
        run: which life of the server this is, drawn by chance: its numbers begin anew when it starts again.
        after: number of the news that must be known before these; 0: these are all there is.
        sequence: number of these news. The same as `after` if there is nothing new.
        placed: nodes that lie elsewhere now, or in another component.
        gone: nodes that are in the merged map no longer.
    """

    run: int
    after: int
    sequence: int
    placed: Mapping[NodeId, MergedPose] = field(default_factory=dict)
    gone: tuple[NodeId, ...] = ()

    def encode(self, agent: str) -> bytes:
        """Encode; raises InvalidValue if it would not decode."""
        groups: dict[tuple[NodeId, int], list[NodeId]] = {}
        for node, where in self.placed.items():
            groups.setdefault((where.frame, node.epoch), []).append(node)
        placed = []
        for (frame, epoch), nodes in sorted(groups.items()):
            places = np.array([self.placed[node].merged_from_node.vector for node in nodes])
            packed = places.astype(NUMBERS).tobytes()
            placed.append([list(frame), epoch, [node.number for node in nodes], packed])
        lost: dict[int, list[int]] = {}
        for node in self.gone:
            lost.setdefault(node.epoch, []).append(node.number)
        gone = [[epoch, numbers] for epoch, numbers in sorted(lost.items())]
        numbers = {"l": self.run, "p": self.after, "q": self.sequence}
        data = pack({"a": check_name(agent), **numbers, "w": placed, "g": gone})
        try:
            PoseNews.decode(data, agent)
        except InvalidMessage as error:
            raise InvalidValue(str(error)) from None
        return data

    @staticmethod
    def decode(data: bytes, agent: str) -> PoseNews:
        """Decode what an agent is told.

        Raises:
            InvalidMessage: it is damaged, or another agent's.
        """
        reader = Reader(data, "poses", MAX_BYTES, 2 * MAX_POSTURES)
        if (told := reader.name("a")) != agent:
            raise reader.error(f"they are of {told}'s nodes, not of {agent}'s")
        placed: dict[NodeId, MergedPose] = {}
        for value in reader.array("w", MAX_GROUPS):
            frame, epoch, numbers, packed = _parts(reader, value, 4)
            placed |= _places(reader, agent, frame, epoch, numbers, packed)
        gone = [
            node
            for value in reader.array("g", MAX_GROUPS)
            for node in _nodes(reader, agent, *_parts(reader, value, 2))
        ]
        sequence = reader.integer("q", 0, MAX_NUMBER)
        after = reader.integer("p", 0, sequence)
        return PoseNews(reader.integer("l", 0, 2**64 - 1), after, sequence, placed, tuple(gone))


def _parts(reader: Reader, value: Any, count: int) -> list[Any]:
    parts = reader.as_array(value, "group", 32)
    # More parts than are known here are a newer program's.
    if len(parts) < count:
        raise reader.error(f"a group has {len(parts)} parts instead of {count}")
    return parts[:count]


def _places(
    reader: Reader, agent: str, frame: Any, epoch: Any, numbers: Any, packed: Any
) -> dict[NodeId, MergedPose]:
    """Of the nodes of one map in one frame."""
    nodes, of = _nodes(reader, agent, epoch, numbers), reader.as_node_id(frame, "frame")
    given = reader.as_binary(packed, "poses", PLACE_BYTES * MAX_POSTURES)
    if len(given) != PLACE_BYTES * len(nodes):
        raise reader.error(f"{len(given)} bytes are not the poses of {len(nodes)} nodes")
    places = np.frombuffer(given, NUMBERS).reshape(-1, 3).astype(np.float64)
    # A comparison with what is no number is false.
    if not (np.abs(places) <= MAX_POSITION).all():
        raise reader.error("a pose is out of range")
    poses = map(Pose2.from_vector, places)
    return {node: MergedPose(of, pose) for node, pose in zip(nodes, poses, strict=True)}


def _nodes(reader: Reader, agent: str, epoch: Any, numbers: Any) -> list[NodeId]:
    of = reader.as_integer(epoch, "epoch", 0, MAX_NUMBER)
    given = reader.as_array(numbers, "nodes", MAX_POSTURES)
    return [NodeId(agent, of, reader.as_integer(number, "node", 0, MAX_NUMBER)) for number in given]
