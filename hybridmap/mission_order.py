"""Missions as values: what one robot shall do, who said so and when, and what has become of it."""

from __future__ import annotations

import secrets
import time
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import MAX_STAMP_NS, Name, Share, Stamp, Words
from mapweave.hybridmap.portal import PortalWait

MAX_KEPT = 200
"""Missions in a history; older ones are dropped."""

MAX_VIA = 16
"""Places that a robot passes on its way to a goal."""

MOST_APART_NS = 86_400_000_000_000
"""By which the stamps of two orders differ at most if both clocks are right: none is under way for a day."""

AT_START = "start"
"""In place of a person: the mission with which an agent is started."""
MAX_TEXT = 64
"""Characters of an id or a name. A limit for messages."""
MAX_BECAUSE = 300
"""Characters of a reason. A limit for messages."""
Because = Annotated[str, Meta(max_length=MAX_BECAUSE)]
"""Why a mission is given, in the words of who gives it."""
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
"""A goal as it was written, or a person's name."""


class MissionKind(StrEnum):
    """What a robot shall do."""

    EXPLORE = "explore"
    CARRIED = "carried"
    """Map while a person moves the robot."""
    GO = "go"
    """Park at a node."""
    STOP = "stop"


class MissionState(StrEnum):
    """What has become of a mission."""

    SENT = "sent"
    """The server keeps it; the robot does not know of it yet."""
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    """The robot gave it up."""
    REFUSED = "refused"
    """It was never begun."""
    REPLACED = "replaced"
    """A newer one came first, or meanwhile."""


OPEN = (MissionState.SENT, MissionState.RUNNING)
"""States that are not final."""


def new_id() -> str:
    """An id for a new mission, drawn by chance."""
    return secrets.token_hex(6)


def later_stamp(now_ns: int, than_ns: int) -> int:
    """Stamp of an order that is given now, and that replaces one with another stamp.

    A stamp of far ahead is not surpassed: there may be no greater one, and what comes later replaces it
    anyway.
    """
    if than_ns - now_ns > MOST_APART_NS:
        return now_ns
    return min(max(now_ns, than_ns + 1), MAX_STAMP_NS)


@dataclass(frozen=True, slots=True)
class MissionRequest:
    """A person's wish, as a map server takes it: the goal is in the person's words.

    Attributes:
        id: drawn by who gives it. The same id is the same mission, however often it comes.
        robot: which robot.
        kind: what it shall do.
        stamp_ns: when it was given; of two missions of a robot the newer one holds, see
            MissionOrder.replaces.
        by: who gave it.
        goal: where to: a node (`r0.1.17`), a named place, `x,y` in the merged map, m, or `home`; empty
            without one.
        via: what to pass before, in order, in the same words.
        because: why, for the history; may be empty.
    """

    id: Name
    robot: Name
    kind: MissionKind
    stamp_ns: Stamp
    by: Text
    goal: Text = ""
    via: Annotated[tuple[Text, ...], Meta(max_length=MAX_VIA)] = ()
    because: Because = ""

    def __post_init__(self) -> None:
        """Refuse a goal too many or too few, and what is too long (InvalidValue)."""
        if len(self.because) > MAX_BECAUSE:
            raise InvalidValue(f"mission {self.kind}: a reason has at most {MAX_BECAUSE} characters")
        if long := [word for word in (self.goal, *self.via) if len(word) > MAX_TEXT]:
            words = f"{long[0][:MAX_TEXT]!r}... is longer than {MAX_TEXT} characters"
            raise InvalidValue(f"mission {self.kind}: {words}")
        if self.via and self.kind is not MissionKind.GO:
            raise InvalidValue(f"mission {self.kind}: takes no places on the way")
        if (self.kind is MissionKind.GO) != bool(self.goal):
            raise InvalidValue(f"mission {self.kind}: {'give' if not self.goal else 'takes no'} goal")


@dataclass(frozen=True, slots=True)
class MissionOrder:
    """A mission as a robot takes it.

    Attributes:
        id: see MissionRequest; likewise robot, kind, stamp_ns, by, goal and because.
        node: where to park; None without a goal.
        via: nodes to pass before, in order.
    """

    id: Name
    robot: Name
    kind: MissionKind
    stamp_ns: Stamp
    by: Text
    node: NodeId | None = None
    goal: Text = ""
    via: Annotated[tuple[NodeId, ...], Meta(max_length=MAX_VIA)] = ()
    because: Because = ""

    def __post_init__(self) -> None:
        """Refuse a node too many or too few (InvalidValue)."""
        if (self.kind is MissionKind.GO) != (self.node is not None):
            raise InvalidValue(f"mission {self.kind}: {'give' if self.node is None else 'takes no'} node")

    @staticmethod
    def new(
        robot: str, kind: MissionKind, by: str, node: NodeId | None = None, after_ns: int = 0
    ) -> MissionOrder:
        """A mission that is given now, and replaces one with the stamp `after_ns`."""
        return MissionOrder(new_id(), robot, kind, later_stamp(time.time_ns(), after_ns), by, node)

    @property
    def rank(self) -> tuple[int, str]:
        """The order of missions: of two of one robot the higher one holds; see `replaces`."""
        return self.stamp_ns, self.id

    def replaces(self, holding: MissionOrder) -> bool:
        """Whether this order, which has just come, replaces the one that holds.

        It does if it is newer, in whatever order the two come. Where their stamps are too far apart, one of
        the clocks is wrong, and the robot's own may be as well: then the order that comes later holds. So no
        stamp keeps a robot from later orders.
        """
        return self.rank > holding.rank or holding.stamp_ns - self.stamp_ns > MOST_APART_NS

    @property
    def words(self) -> str:
        """The mission in words."""
        if self.node is None:
            return str(self.kind)
        return (
            f"{self.kind} to {self.node}"
            + (f" ({self.goal})" if self.goal not in ("", str(self.node)) else "")
            + (f" via {', '.join(map(str, self.via))}" if self.via else "")
        )


@dataclass(frozen=True, slots=True)
class MissionReport:
    """What has become of a mission.

    Attributes:
        order: the mission.
        state: the last states are final.
        progress: share of the way to the goal; 1 when it is done.
        reason: why, in words.
        passed: how many of the nodes of `via` were passed.
        portal: the portal at which the robot waits; None while it drives.
    """

    order: MissionOrder
    state: MissionState
    progress: Share = 0.0
    reason: Words = ""
    passed: Annotated[int, Meta(ge=0, le=MAX_VIA)] = 0
    portal: PortalWait | None = None

    @property
    def open(self) -> bool:
        """Whether it may still change."""
        return self.state in OPEN

    def supersedes(self, other: MissionReport) -> bool:
        """Whether it says more than another report on the same mission: a final state stays."""
        return other.state is MissionState.SENT or (other.open and self.state is not MissionState.SENT)


@dataclass(frozen=True, slots=True)
class Missions:
    """Missions, oldest first."""

    reports: Annotated[tuple[MissionReport, ...], Meta(max_length=MAX_KEPT)] = ()

    @staticmethod
    def newest(reports: list[MissionReport]) -> Missions:
        """The missions to keep: the newest of each robot first, so that none displaces those of others."""
        turns, ranked = Counter[str](), []
        for report in sorted(reports, key=lambda report: report.order.rank, reverse=True):
            robot = report.order.robot
            ranked.append((turns[robot], report))
            turns[robot] += 1
        kept = (report for _, report in sorted(ranked, key=lambda one: one[0])[:MAX_KEPT])
        return Missions(tuple(sorted(kept, key=lambda report: report.order.rank)))

    def awaited(self) -> set[str]:
        """The robots that get a mission once they are back, other than a stop."""
        return {
            report.order.robot
            for report in self.reports
            if report.state is MissionState.SENT and report.order.kind is not MissionKind.STOP
        }
