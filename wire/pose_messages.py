"""Merged poses of an agent's nodes, from a server, as bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import NodeId, check_name
from mapweave.hybridmap.limits import MAX_POSITION, Name, Number
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.log_messages import Id
from mapweave.wire.packing import Limit, pack, unpack

MAX_POSTURES = 1 << 18
"""Nodes of one agent in one message."""
LIMIT = Limit("poses", 32 * MAX_POSTURES, 2 * MAX_POSTURES)
NUMBERS = np.dtype("<f4")
PLACE_BYTES = 3 * NUMBERS.itemsize


class _Placed(msgspec.Struct, array_like=True):
    """Nodes of one map in one component."""

    frame: NodeId
    epoch: Number
    numbers: list[Number]
    poses: bytes


class _Gone(msgspec.Struct, array_like=True):
    epoch: Number
    numbers: list[Number]


class _Poses(msgspec.Struct):
    agent: Name = msgspec.field(name="a")
    run: Id = msgspec.field(name="l")
    after: Number = msgspec.field(name="p")
    sequence: Number = msgspec.field(name="q")
    placed: list[_Placed] = msgspec.field(name="w")
    gone: list[_Gone] = msgspec.field(name="g")


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
        run: random number of this run of the server: its numbers begin again after a restart.
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
            numbers = [node.number for node in nodes]
            placed.append(_Placed(frame, epoch, numbers, places.astype(NUMBERS).tobytes()))
        lost: dict[int, list[int]] = {}
        for node in self.gone:
            lost.setdefault(node.epoch, []).append(node.number)
        removed = [_Gone(epoch, numbers) for epoch, numbers in sorted(lost.items())]
        message = _Poses(check_name(agent), self.run, self.after, self.sequence, placed, removed)
        data = pack(msgspec.to_builtins(message, builtin_types=(bytes,)))
        try:
            PoseNews.decode(data, agent)
        except InvalidMessage as error:
            raise InvalidValue(str(error)) from None
        return data

    @staticmethod
    def decode(data: bytes, agent: str) -> PoseNews:
        """Decode what an agent is message.

        Raises:
            InvalidMessage: it is damaged, or another agent's.
        """
        message: _Poses = unpack(data, _Poses, LIMIT)
        if message.agent != agent:
            raise InvalidMessage(f"poses: they are of {message.agent}'s nodes, not of {agent}'s")
        if message.after > message.sequence:
            raise InvalidMessage(f"poses: {message.sequence} comes before {message.after}")
        placed: dict[NodeId, MergedPose] = {}
        for group in message.placed:
            poses = _read_poses(group.poses, len(group.numbers))
            for number, pose in zip(group.numbers, poses, strict=True):
                placed[NodeId(agent, group.epoch, number)] = MergedPose(group.frame, pose)
        gone = tuple(NodeId(agent, group.epoch, number) for group in message.gone for number in group.numbers)
        return PoseNews(message.run, message.after, message.sequence, placed, gone)


def _read_poses(packed: bytes, count: int) -> list[Pose2]:
    if len(packed) != PLACE_BYTES * count:
        raise InvalidMessage(f"poses: {len(packed)} bytes are not those of {count} nodes")
    places = np.frombuffer(packed, NUMBERS).reshape(-1, 3).astype(np.float64)
    # A comparison with what is no number is false.
    if not (np.abs(places) <= MAX_POSITION).all():
        raise InvalidMessage("poses: a number is out of range")
    return [Pose2.from_vector(place) for place in places]
