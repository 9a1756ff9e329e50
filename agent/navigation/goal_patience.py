"""When a goal is given up: how long the robot has not got on, and what keeps it from its goal."""

from mapweave.agent.robots_in_view import RobotBeside
from mapweave.hybridmap.ids import NodeId

REFUSED = 20.0
"""A fleet that answers for so long that there is no way is believed, s: it may first have to merge."""
YIELDED = 30.0
"""How long a robot waits for another one before it looks for another way, or gives its goal up, s."""


class GoalPatience:
    """How long a robot goes on trying to reach one goal.

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

    def reach(self, now: float) -> None:
        """The robot is at a stop on its way: edges that it has driven count again from here.

        Args:
            now: s.
        """
        self._driven.clear()
        self._progressed_at = now

    def pause(self, seconds: float) -> None:
        """The robot must not move; that time, s, does not count."""
        self._progressed_at += seconds
        self._held_since += seconds

    def drive(self, edge: tuple[NodeId, NodeId], beside: RobotBeside | None, now: float) -> None:
        """The robot drives: it gets on if it had not been on that edge.

        Args:
            edge: two nodes.
            beside: the robot next to this one.
            now: s.
        """
        if beside is None or beside.robot != self._held_by:
            self._held_by = ""
        if edge not in self._driven:
            self._driven.add(edge)
            self._progressed_at = now

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

    def ended(self, beside: RobotBeside | None, now: float) -> str:
        """Why the goal is given up; empty if it is not.

        A robot in the way that has stayed beside this one since it was blocked leaves no way: where there is
        another one, this robot has left.

        Args:
            beside: the robot next to this one.
            now: s.
        """
        held = beside is not None and beside.robot == self._held_by
        if held and now - self._held_since > YIELDED:
            return f"{self._held_by} stands in the way {self._held_where}, and there is no other"
        if now - self._progressed_at > self._patience:
            return f"no nearer in {self._patience:g} s: {self.trouble}"
        return ""
