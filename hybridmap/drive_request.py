"""A person drives a robot: velocity commands, and what its agent answers."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.limits import Number, Stamp

FASTEST = 1e3
"""No robot drives or turns faster, m/s and rad/s."""
Speed = Annotated[float, Meta(ge=-FASTEST, le=FASTEST)]
Limit = Annotated[float, Meta(ge=0.0, le=FASTEST)]


@dataclass(frozen=True)
class DriveRequest:
    """A velocity command of a person.

    Attributes:
        session: random number of the program that the person drives with.
        forward: m/s.
        turn: rad/s, counter-clockwise.
        answer_ns: `answer_ns` of the last answer that the program received; 0 for its first request.
        release: the person gives the wheels back to the mission.
        by: who drives; where the key of the request ends with a name, that holds.
    """

    session: Number
    forward: Speed = 0.0
    turn: Speed = 0.0
    answer_ns: Stamp = 0
    release: bool = False
    by: Annotated[str, Meta(max_length=64)] = ""


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
    answer_ns: Stamp
    max_forward: Limit
    max_turn: Limit
