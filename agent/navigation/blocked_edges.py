"""Pairs of nodes between which the robot could not drive; each is forgotten after a while."""

from __future__ import annotations

from mapweave.agent.settings import NavigatorSettings
from mapweave.hybridmap.node import NodeId

Pair = tuple[NodeId, NodeId]


class BlockedEdges:
    """Blocked pairs, in the order of their last block."""

    def __init__(self, settings: NavigatorSettings | None = None) -> None:
        """Start without blocks."""
        self._settings = settings or NavigatorSettings()
        self._until: dict[Pair, float] = {}
        self._times: dict[Pair, int] = {}

    def add(self, a: NodeId, b: NodeId, now: float) -> None:
        """Add a pair between which the robot could not drive, in either direction.

        Args:
            a: one node.
            b: the other.
            now: s.
        """
        pair = (a, b) if a <= b else (b, a)
        times = self._times[pair] = self._times.get(pair, 0) + 1
        self._until.pop(pair, None)
        self._until[pair] = now + min(
            self._settings.blocked_first * 2.0 ** (times - 1), self._settings.blocked_longest
        )

    def at(self, now: float) -> tuple[Pair, ...]:
        """Pairs that count as blocked at a time, s."""
        return tuple(pair for pair, until in self._until.items() if now < until)
