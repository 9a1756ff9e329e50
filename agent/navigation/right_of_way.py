"""Whether the way ahead is free of other robots: the fleet is asked, and the robot does not wait for answers.

Without an answer the robot drives on: its rangers keep it from touching anything, as without a server.
"""

from collections.abc import Sequence
from enum import StrEnum

from mapweave.agent.localization.fix import Fix
from mapweave.agent.mission import MayIDrive
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.navigation.goal_patience import YIELDED
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.query import ReserveAnswer

EVERY = 1.0
"""Time between two questions, s."""
OVERDUE = 3.0
"""A question without an answer for so long is lost, s."""


class Passage(StrEnum):
    """The answer to a robot that asks to drive on."""

    FREE = "free"
    HELD = "held by another robot"
    STUCK = "held for too long"
    ASIDE = "the robot must step aside"
    CLOSED = "closed by a person"


class RightOfWay:
    """Asks for the right of way on one drive along a route.

    Attributes:
        holder: the robot that drives or stands where this one wants to; empty without one.
        reason: why this one waits, in words.
        occupied: whether the holder stands at the end of the route.
        aside: the node to which this one must step aside; None if it need not.
    """

    def __init__(self, motion: MotionPrimitives, route: Sequence[NodeId]) -> None:
        """Take a route; nothing is known of it yet."""
        self.holder = self.reason = ""
        self.occupied = self._closed = False
        self.aside: NodeId | None = None
        self._motion = motion
        self._route = tuple(route)
        self._asked: tuple[int, int, float] | None = None
        self._last = -EVERY
        self._granted: int | None = None
        self._held_since: float | None = None
        self._called = motion.now

    def passage(self, leg: int, fix: Fix) -> Passage:
        """Whether the robot may drive to a node of the route; called each tick."""
        now = self._motion.now
        paused, self._called = now - self._called, now
        if paused > EVERY and self._held_since is not None:
            # It was stopped by something else meanwhile: it has not waited for the other robot.
            self._held_since += paused
        if self._asked is not None:
            number, first, at = self._asked
            answer = self._motion.answer(number)
            if answer is not None or now - at > OVERDUE:
                self._asked = None
                self._take(None if answer is None else answer.content, first)
        if self._asked is None and now - self._last >= EVERY:
            number = self._motion.number()
            self._motion.post(MayIDrive(number, fix.node, fix.node_from_robot.mean, self._route[leg:]))
            self._asked, self._last = (number, leg, now), now
        if self._closed:
            return Passage.CLOSED
        if self._granted is not None and leg < self._granted:
            self._held_since = None
            return Passage.FREE
        if self.aside is not None:
            return Passage.ASIDE
        self._held_since = now if self._held_since is None else self._held_since
        return Passage.STUCK if now - self._held_since > YIELDED else Passage.HELD

    def _take(self, content: object, first: int) -> None:
        if isinstance(content, ReserveAnswer):
            self._granted, self.holder, self.aside = first + content.granted, content.holder, content.aside
            self.reason, self.occupied, self._closed = content.reason, content.occupied, content.closed
        else:
            self._granted, self.holder, self.aside = len(self._route), "", None
            self.occupied = self._closed = False
