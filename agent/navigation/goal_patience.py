"""When a goal is given up: how long the robot has not got on, and what keeps it from its goal."""

from __future__ import annotations

from mapweave.hybridmap.node import NodeId

REFUSED = 20.0
"""A fleet that answers for so long that there is no way is believed, s: it may first have to merge."""
YIELDED = 30.0
"""How long a robot waits for another one before it looks for another way, or gives its goal up, s."""


class GoalPatience:
    """Of one goal.

    Attributes:
        trouble: what keeps the robot from its goal, in words.
        refused_since: when the fleet first said that there is no way, s; None if there was one since.
    """

    def __init__(self, patience: float) -> None:
        """Begin.

        Args:
            patience: the goal is given up when the robot has not got on for so long, s.
        """
        self.trouble = "it does not know where it is"
        self.refused_since: float | None = None
        self._patience = patience
        self._progressed_at = 0.0
        self._driven: set[tuple[NodeId, NodeId]] = set()
        self._held_by, self._held_where, self._held_since = "", "", 0.0

    def pause(self, seconds: float) -> None:
        """The robot had to stand for so long: that does not count."""
        self._progressed_at += seconds

    def drive(self, edge: tuple[NodeId, NodeId], now: float) -> None:
        """The robot drives along an edge at a time, s: it gets on if it had not been there."""
        if edge not in self._driven:
            self._driven.add(edge)
            self._progressed_at, self._held_by = now, ""

    def block(self, where: str, robot: str, now: float) -> None:
        """The robot is blocked.

        Args:
            where: in words.
            robot: that stands there; empty if it is something else.
            now: s.
        """
        if robot != self._held_by:
            self._held_by, self._held_since = robot, now
        self._held_where = where

    def refused(self, refusing: bool, now: float) -> str:
        """Why the goal is given up when the fleet says again that there is no way; empty if it is not."""
        since = self.refused_since
        return self.trouble if refusing and since is not None and now - since > REFUSED else ""

    def shut_off(self, beside: str, now: float) -> str:
        """Why the goal is given up where every way is blocked; empty if it is not yet.

        Args:
            beside: the robot next to this one; empty without one.
            now: s.
        """
        if not self._held_by or beside != self._held_by or now - self._held_since <= YIELDED:
            return ""
        return f"{beside} stands in the way {self._held_where}, and there is no other"

    def ended(self, now: float) -> str:
        """Why the goal is given up; empty if it is not."""
        if now - self._progressed_at <= self._patience:
            return ""
        return f"no nearer in {self._patience:g} s: {self.trouble}"
