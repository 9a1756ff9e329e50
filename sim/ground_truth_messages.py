"""Questions to a simulator about the ground truth, and their answers.

A question is a MessagePack map with the operation in `op`.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.limits import Amount, Coordinate, Key, Name, Number, Stamp, Words
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.wire.packing import Limit

QUESTION = Limit("control", 1 << 20, 1 << 20)
ANSWER = Limit("answer of the simulator", 64 * 2**20, 2_000_000)
"""A limit for messages between processes of one machine: an answer has the images of all robots."""


class _Question(msgspec.Struct, tag_field="op"):
    pass


class KidnapRequest(_Question, tag="kidnap"):
    """Put a robot elsewhere."""

    robot: Name
    world_from_robot: tuple[Coordinate, Coordinate, Coordinate]


class Apply(_Question, tag="apply"):
    """Let something happen, as a scenario's table says it."""

    event: Annotated[dict[Key, Any], Meta(max_length=64)]


class Advance(_Question, tag="advance"):
    """Let time pass until a tick is over and every robot has finished with it."""

    tick: Number


class AskSnapshot(_Question, tag="snapshot"):
    """What is there to see from above?"""


class AskStatus(_Question, tag="status"):
    """What is the simulation doing?"""


class AskTruth(_Question, tag="truth_at"):
    """Where was a robot at times that are over?"""

    robot: Name
    stamps_ns: Annotated[list[Stamp], Meta(max_length=100_000)]


class AskTrajectory(_Question, tag="trajectory"):
    """Where was a robot in each tick?"""

    robot: Name


class AskPlan(_Question, tag="plan"):
    """What stands where?"""


Question = KidnapRequest | Apply | Advance | AskSnapshot | AskStatus | AskTruth | AskTrajectory | AskPlan


@dataclass(frozen=True)
class Done:
    """The operation is done; `said` describes it."""

    said: Words = ""


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """One robot, seen from above.

    Attributes:
        world_from_robot: true pose.
        collisions: their number.
        active: whether its agent takes part.
    """

    world_from_robot: Pose2
    collisions: Number
    active: bool


@dataclass(frozen=True)
class SimStatus:
    """The simulation now.

    Attributes:
        tick: ticks that are over.
        stamp_ns: the simulation's time.
        robots: by name.
        wall: s of the wall's clock by part: `waiting` for agents, `replying`, `control`, and the parts of the
            simulation.
    """

    tick: Number
    stamp_ns: Stamp
    robots: dict[Name, RobotStatus] = field(default_factory=dict)
    wall: dict[Key, Amount] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class TrueTrajectory:
    """Where a robot truly was.

    Attributes:
        stamps_ns: (N,).
        world_from_robot: (N, 3) m, m, rad.
    """

    stamps_ns: NDArray[np.int64]
    world_from_robot: Array

    def __post_init__(self) -> None:
        """Refuse what is no trajectory (InvalidValue)."""
        if self.world_from_robot.shape != (len(self.stamps_ns), 3) or self.stamps_ns.ndim != 1:
            raise InvalidValue(f"{self.world_from_robot.shape} poses at {self.stamps_ns.shape} times")
        if not np.isfinite(self.world_from_robot).all():
            raise InvalidValue("a pose has numbers that are not finite")
