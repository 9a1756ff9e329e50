"""An agent's status as a message: for people, and for scenarios."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from mapweave.agent.drive_statistics import DriveStatistics
from mapweave.agent.pipeline import Status
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.log_messages import Scalar, decode_record, encode_record

MAX_WORDS = 500
"""Characters of a status text."""

T = TypeVar("T")


@dataclass(frozen=True)
class AgentStatus:
    """A status as others receive it.

    Attributes:
        status: of the agent.
        stamp_ns: time of the observation that it describes.
        epoch: of the map that it makes.
        unsent: changes that no server has on its disk yet.
        traffic: bytes that it has sent and received over the fleet's network since it began.
        linked: whether it sees its map server.
        placed: nodes of its map of which it knows where they lie in the merged map.
    """

    status: Status
    stamp_ns: int
    epoch: int = 0
    unsent: int = 0
    traffic: int = 0
    linked: bool = False
    placed: int = 0

    @property
    def fix_node(self) -> NodeId | None:
        """The node that the robot knows itself by, if it navigates and knows."""
        return self.status.fix_node


@dataclass(frozen=True)
class DriveAnswer:
    """Answer to a person's velocity command.

    Attributes:
        report: what the robot is doing.
        answer_ns: time of the answer by the agent's clock; the next command repeats it.
        max_forward: speed limit of the robot, m/s.
        max_turn: rate limit, rad/s.
    """

    report: AgentStatus
    answer_ns: int
    max_forward: float
    max_turn: float


def encode_agent_status(report: AgentStatus) -> bytes:
    """What the robot is doing, for people and for tests."""
    return encode_record(_record(report))


def encode_drive_answer(answer: DriveAnswer) -> bytes:
    """A status with three numbers more."""
    more = {
        "answer_ns": answer.answer_ns,
        "max_forward": float(answer.max_forward),
        "max_turn": float(answer.max_turn),
    }
    return encode_record(_record(answer.report) | more)


def decode_drive_answer(payload: bytes) -> DriveAnswer:
    """Read an answer.

    Raises:
        InvalidMessage: it is none.
    """
    values = decode_record(payload)
    try:
        return DriveAnswer(
            decode_agent_status(payload),
            _typed(values, "answer_ns", int),
            _typed(values, "max_forward", float),
            _typed(values, "max_turn", float),
        )
    except (KeyError, ValueError) as error:
        raise InvalidMessage(f"drive answer: {error}") from None


def _record(report: AgentStatus) -> dict[str, Scalar]:
    status = report.status
    pose, fix = status.map_from_robot, status.node_from_robot
    return {
        "stamp_ns": report.stamp_ns,
        "epoch": report.epoch,
        "unsent": report.unsent,
        "traffic": report.traffic,
        "linked": report.linked,
        "placed": report.placed,
        "astray": status.astray,
        "doing": _one_line(status.doing),
        "detail": _one_line(status.detail),
        "nodes": status.nodes,
        "tracked": status.tracked,
        "finished": status.finished,
        "x": float(pose.x),
        "y": float(pose.y),
        "heading": float(pose.heading),
        "mission": status.mission,
        "fix_node": "" if status.fix_node is None else str(status.fix_node),
        "fix_x": float(fix.x),
        "fix_y": float(fix.y),
        "fix_heading": float(fix.heading),
        "legs": status.legs,
        "edges_driven": status.tally.edges,
        "nodes_skipped": status.tally.skipped,
        "relocalizations": status.tally.relocalizations,
        "blocks": status.tally.blocks,
    }


def _one_line(text: str) -> str:
    """Text as a record can hold it: a status may quote the text of a server or a driver."""
    return "".join(c if c.isprintable() else " " for c in text)[:MAX_WORDS]


def decode_agent_status(payload: bytes) -> AgentStatus:
    """Read a status.

    Raises:
        InvalidMessage: it is none.
    """
    values = decode_record(payload)
    try:
        status = Status(
            doing=_typed(values, "doing", str),
            detail=_typed(values, "detail", str),
            nodes=_typed(values, "nodes", int),
            tracked=_typed(values, "tracked", int),
            map_from_robot=_pose(values, "x", "y", "heading"),
            finished=_typed(values, "finished", bool),
            mission=_typed(values, "mission", str),
            fix_node=NodeId.parse(_typed(values, "fix_node", str)) if values["fix_node"] else None,
            node_from_robot=_pose(values, "fix_x", "fix_y", "fix_heading"),
            legs=_typed(values, "legs", int),
            astray=_typed(values, "astray", bool),
            tally=DriveStatistics(
                edges=_typed(values, "edges_driven", int),
                skipped=_typed(values, "nodes_skipped", int),
                relocalizations=_typed(values, "relocalizations", int),
                blocks=_typed(values, "blocks", int),
            ),
        )
        return AgentStatus(
            status=status,
            stamp_ns=_typed(values, "stamp_ns", int),
            epoch=_typed(values, "epoch", int),
            unsent=_typed(values, "unsent", int),
            traffic=_typed(values, "traffic", int),
            linked=_typed(values, "linked", bool),
            placed=_typed(values, "placed", int),
        )
    except (KeyError, ValueError, InvalidValue) as error:
        raise InvalidMessage(f"agent status: {error}") from None


def _typed(values: Mapping[str, Scalar], name: str, kind: type[T]) -> T:
    value = values[name]
    if type(value) is not kind:
        raise ValueError(f"{name} must be {kind.__name__}, not {value!r}")
    return value


def _pose(values: Mapping[str, Scalar], x: str, y: str, heading: str) -> Pose2:
    return Pose2(_typed(values, x, float), _typed(values, y, float), _typed(values, heading, float))
