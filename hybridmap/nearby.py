"""Where other robots are around a robot: a question and its answer, plain values."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import Amount, Name, Words
from mapweave.hybridmap.pose import Pose2

MAX_STARTS = 8
"""Places at which a robot may be, in one question. A limit for messages."""
MAX_NEARBY = 16
"""Robots in one answer, nearest first: more do not stand around one robot."""

Size = Annotated[float, Meta(ge=0.0, le=5.0)]
"""m, of a robot that drives indoors."""
Sigma = Annotated[float, Meta(ge=0.0, le=100.0)]
"""m or rad."""


@dataclass(frozen=True, slots=True)
class NearbyRequest:
    """Which robots are around this one? The server keeps what it says of itself, for the others' questions.

    Attributes:
        robot: its name.
        starts: nodes around it, the best first, each with `node_from_robot`. The first that is in the merged
            map counts: the newest are not merged yet.
        sigma: standard deviation of its position from there, m.
        heading_sigma: likewise of its heading, rad.
        radius: of its footprint, m.
        height: of its body, m.
        speed: its limit, m/s.
    """

    robot: Name
    starts: Annotated[tuple[tuple[NodeId, Pose2], ...], Meta(max_length=MAX_STARTS)]
    sigma: Sigma
    heading_sigma: Sigma
    radius: Size
    height: Size
    speed: Annotated[float, Meta(ge=0.0, le=1000.0)]


@dataclass(frozen=True, slots=True)
class NearbyRobot:
    """Another robot, as it was `age` before the question.

    Attributes:
        robot: its name.
        robot_from_other: its pose, seen from the asking robot at the time of the question.
        sigma: standard deviation of that position, without what it has driven since, m.
        radius: of its footprint, m.
        height: of its body, m.
        speed: its limit, m/s.
        age: how old this is, s.
    """

    robot: Name
    robot_from_other: Pose2
    sigma: Amount
    radius: Size
    height: Size
    speed: Annotated[float, Meta(ge=0.0, le=1000.0)]
    age: Amount


@dataclass(frozen=True, slots=True)
class NearbyAnswer:
    """The other robots of the same component, nearest first.

    Attributes:
        robots: the others.
        reason: why there are none, in words; may be empty.
        aside: the asking robot has no way and stands in another's: the node where it is in no way; None if it
            stands in no way, or there is no such node.
    """

    robots: Annotated[tuple[NearbyRobot, ...], Meta(max_length=MAX_NEARBY)]
    reason: Words = ""
    aside: NodeId | None = None
