"""Missions from an operator, and the pipeline's questions to the fleet: plain values."""

from dataclasses import dataclass, field

from mapweave.agent.observation import Command
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.nearby import NearbyAnswer
from mapweave.hybridmap.portal import PortalWait
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import (
    KnownAnswer,
    Obstacle,
    RelocalizeAnswer,
    ReserveAnswer,
    RouteAnswer,
    View,
)


@dataclass(frozen=True)
class Idle:
    """Stand still."""


@dataclass(frozen=True)
class Explore:
    """Map all reachable floor."""


@dataclass(frozen=True)
class Carried:
    """Map while a person moves the robot."""


@dataclass(frozen=True)
class GoTo:
    """Park where a node's image was taken; the node may be another robot's.

    Attributes:
        node: the goal.
        via: nodes to pass before, in order.
        passed: how many of these were passed before the robot was switched off.
        portal: the portal at which it was then.
    """

    node: NodeId
    via: tuple[NodeId, ...] = ()
    passed: int = 0
    portal: PortalWait | None = None


Mission = Idle | Explore | Carried | GoTo


@dataclass(frozen=True)
class Driven:
    """A person drives the robot, whatever its mission.

    Attributes:
        command: of the person.
        silence: s without a command, if that is too long: the command is then to stand; else 0.
    """

    command: Command
    silence: float = 0.0


@dataclass(frozen=True, eq=False)
class WhereAmI:
    """Question to the fleet's map: where was this view taken?

    Attributes:
        number: of the question; the answer repeats it.
        view: of the robot.
        near: the robot knows that it is on the floor of this node; None if it does not.
    """

    number: int
    view: View
    near: NodeId | None = None


@dataclass(frozen=True)
class WhichWay:
    """Question to the fleet's map: how to get from one node to another?

    Attributes:
        number: of the question; the answer repeats it.
        start: node by which the robot is localized.
        goal: node where it wants to be.
        start_from_robot: where it is exactly.
        blocked: pairs of nodes between which it could not drive.
        obstacles: places where it could not drive.
    """

    number: int
    start: NodeId
    goal: NodeId
    start_from_robot: Pose2 = field(default_factory=Pose2)
    blocked: tuple[tuple[NodeId, NodeId], ...] = ()
    obstacles: tuple[Obstacle, ...] = ()


@dataclass(frozen=True)
class WhatIsKnown:
    """Question to the fleet's map: what have others mapped around here?

    Attributes:
        number: of the question; the answer repeats it.
        map: the robot's own.
        x: of the middle, m, in that map.
        y: of the middle, m, in that map.
        reach: how far around, m.
    """

    number: int
    map: MapId
    x: float
    y: float
    reach: float


@dataclass(frozen=True)
class MayIDrive:
    """Question to the fleet: is the way ahead free of other robots?

    Attributes:
        number: of the question; the answer repeats it.
        start: node by which the robot is localized.
        start_from_robot: where it is exactly.
        route: the nodes ahead, in order.
    """

    number: int
    start: NodeId
    start_from_robot: Pose2
    route: tuple[NodeId, ...]


@dataclass(frozen=True)
class WhoIsNear:
    """Question to the fleet: which robots are around this one?

    Attributes:
        number: of the question; the answer repeats it.
        starts: nodes around the robot, the best first, each with `node_from_robot`.
        sigma: standard deviation of its position from there, m.
        heading_sigma: likewise of its heading, rad.
        radius: of its footprint, m.
        height: of its body, m.
        speed: its limit, m/s.
    """

    number: int
    starts: tuple[tuple[NodeId, Pose2], ...]
    sigma: float
    heading_sigma: float
    radius: float
    height: float
    speed: float


Question = WhereAmI | WhichWay | WhatIsKnown | MayIDrive | WhoIsNear
AnswerContent = RelocalizeAnswer | RouteAnswer | KnownAnswer | ReserveAnswer | NearbyAnswer


@dataclass(frozen=True, eq=False)
class ServerAnswer:
    """A server's answer to a question of this robot.

    Attributes:
        number: of the question.
        content: None without an answer.
        error: the reason then, if it is known.
        retry_after: seconds after which a server that was only busy may answer; else 0.
    """

    number: int
    content: AnswerContent | None
    error: str = ""
    retry_after: float = 0.0
