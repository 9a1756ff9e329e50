"""What a robot is doing: for people, for the map server, and for scenarios."""

from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.drive_statistics import DriveStatistics
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import Amount, Name, Number, Share, Stamp
from mapweave.hybridmap.mission_order import MissionReport
from mapweave.hybridmap.portal import PortalWait
from mapweave.hybridmap.pose import Pose2

MAX_STATUS_WORDS = 500
"""Characters of a line. A limit for messages."""
MAX_ROBOTS = 1024
"""Robots in a status. A limit for messages."""
MOST_AHEAD = 64
"""Nodes of a robot's way in a status. A limit for messages; of a longer way the beginning."""
MAX_ACCUSATION = 1000
"""Characters. A limit for messages."""
Line = Annotated[str, Meta(max_length=MAX_STATUS_WORDS)]

IDENTITY = Pose2()
NOTHING_DRIVEN = DriveStatistics()
NO_COMPONENT = -1
LONGEST_STATUS_PERIOD = 4.0
"""Between two statuses of a robot, s. It sends two a second, unless a server with many robots wants fewer."""
FIRST_STATUS_PERIOD = 2.0
"""As long as no server has said how often, s: robots that are switched on together would send thousands."""
SILENT = 5.0
"""A robot that has sent nothing for longer is named as silent, s."""


def one_line(text: str) -> str:
    """Text as a message can hold it: a status may quote the text of a server or a driver."""
    return "".join(c if c.isprintable() else " " for c in text)[:MAX_STATUS_WORDS]


@dataclass(frozen=True)
class Status:
    """What the robot's pipeline is doing.

    Attributes:
        doing: in words.
        detail: why, or how far.
        nodes: nodes of the own map.
        tracked: features tracked in the image.
        map_from_robot: estimated pose in its own map while mapping.
        finished: whether the mission is complete.
        mission: what the pipeline does.
        fix_node: the node by which the robot is localized while navigating.
        node_from_robot: pose in that node's frame.
        legs: nodes on the first route of the drive, beginning and goal included.
        lost: whether it has given up localizing on its own map: a new map must be begun.
        relocalizing: whether it searches for a place of its own map; `map_from_robot` is then meaningless.
        located: whether `map_from_robot` comes from this observation.
        given_up: whether it stands, since the goal cannot be reached; `detail` is the reason.
        progress: share of the present route that is driven.
        drive: statistics of the drive so far.
        passed: how many of the nodes that it must pass before its goal it has passed.
        portal: the portal at which it waits; None while it drives.
        covariance: of the pose by which the robot knows itself, in its own frame: xx, xy, yy, m^2, and of the
            heading, rad^2; zeros if it is not known.
    """

    doing: Line
    detail: Line
    nodes: Number
    tracked: Number
    map_from_robot: Pose2
    finished: bool
    mission: Line = "idle"
    fix_node: NodeId | None = None
    node_from_robot: Pose2 = IDENTITY
    legs: Number = 0
    lost: bool = False
    relocalizing: bool = False
    located: bool = False
    given_up: bool = False
    progress: Share = 0.0
    drive: DriveStatistics = NOTHING_DRIVEN
    passed: Number = 0
    portal: PortalWait | None = None
    covariance: tuple[Amount, float, Amount, Amount] = (0.0, 0.0, 0.0, 0.0)

    @property
    def words(self) -> str:
        """What the pipeline is doing, and why or how far."""
        return f"{self.doing}: {self.detail}" if self.detail else self.doing


@dataclass(frozen=True)
class HandDrive:
    """A drive by hand, the last one.

    Attributes:
        by: who drives: the name in the key of the commands, else what they say.
        begin_ns: of the drive, wall time of the robot since 1970.
        over: whether it has ended.
    """

    by: Annotated[str, Meta(max_length=64)]
    begin_ns: Stamp
    over: bool = False


@dataclass(frozen=True)
class AgentStatus:
    """A status as others receive it.

    Attributes:
        status: of the pipeline.
        stamp_ns: time of the observation that it describes.
        robot: its name; empty before it has one.
        epoch: of the map that it makes.
        unsent: changes that no server has on its disk yet.
        traffic: bytes that it has sent and received over the fleet's network since it began.
        linked: whether it sees its map server.
        placed: nodes of its map of which it knows where they lie in the merged map.
        mission: the mission that holds, and what has become of it.
        battery: charge, if the driver tells it.
        last_error: why its base does not answer, or that it reports nothing, else why nothing is saved or
            taken at present, else why its questions to the fleet have no answer, in words; empty once that is
            over.
        error_age: for how long the last of these has been so, s.
        skipped: images that it has skipped because a tick took too long.
        drive: who drives it by hand, or has last since its agent began; None without a drive.
    """

    status: Status
    stamp_ns: Stamp
    robot: Annotated[str, Meta(max_length=32)] = ""
    epoch: Number = 0
    unsent: Number = 0
    traffic: Number = 0
    linked: bool = False
    placed: Number = 0
    mission: MissionReport | None = None
    battery: Share | None = None
    last_error: Line = ""
    error_age: Amount = 0.0
    skipped: Number = 0
    drive: HandDrive | None = None

    @property
    def map(self) -> MapId:
        """The map that it makes."""
        return MapId(self.robot, self.epoch)


@dataclass(frozen=True)
class RobotEntry:
    """One robot, as a map server sees it.

    Attributes:
        robot: its name.
        alive: whether its agent is there.
        age: since its last status, s.
        status: the last one; None if none has come.
        merged_from_robot: where it is in the merged map, if that is known.
        component: number of that map's component; -1 if it is not known.
        place: the name of the place where it is; empty if it has none.
        floor: the floor of that map's component; empty if it is not known.
        over_quota: what the server holds back of it, in words; empty if it sends and asks what it may.
        accusation: what the server holds against the newest of its maps with which something is wrong; empty
            if there is none.
        missing: changes that the server knows of and lacks.
        lag: for how long it knows of one of them, s.
        newest: the newest node of the map that it makes, as far as that is merged; None without one.
        links: of that map with others.
        apart: why that map is one with no other; empty if it is, or if there is no other.
        ahead: the next nodes of its way, in order; empty while it has none, or asks another server.
    """

    robot: Name
    alive: bool
    age: Amount = 0.0
    status: AgentStatus | None = None
    merged_from_robot: Pose2 | None = None
    component: Annotated[int, Meta(ge=-1)] = NO_COMPONENT
    place: Annotated[str, Meta(max_length=64)] = ""
    floor: Annotated[str, Meta(max_length=256)] = ""
    over_quota: Line = ""
    accusation: Annotated[str, Meta(max_length=MAX_ACCUSATION)] = ""
    missing: Number = 0
    lag: Amount = 0.0
    newest: NodeId | None = None
    links: Number = 0
    apart: Annotated[str, Meta(max_length=MAX_ACCUSATION)] = ""
    ahead: Annotated[tuple[NodeId, ...], Meta(max_length=MOST_AHEAD)] = ()


@dataclass(frozen=True)
class FleetStatus:
    """All robots that a map server knows of, by name."""

    robots: Annotated[tuple[RobotEntry, ...], Meta(max_length=MAX_ROBOTS)] = field(default=())
