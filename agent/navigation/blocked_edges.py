"""Pairs of nodes between which the robot could not drive; each is forgotten after a while."""

from __future__ import annotations

from dataclasses import dataclass

from mapweave.hybridmap.node import NodeId

Pair = tuple[NodeId, NodeId]


@dataclass(frozen=True)
class BlockedEdgeSettings:
    """How long a block is remembered.

    Attributes:
        forget: after the first time, s: people move on.
        longest: each further time it is remembered twice as long, up to this, s: walls stay.
    """

    forget: float = 15.0
    longest: float = 120.0


class BlockedEdges:
    """Blocked pairs, in the order of their last block."""

    def __init__(self, settings: BlockedEdgeSettings | None = None) -> None:
        """Start without blocks."""
        self._settings = settings or BlockedEdgeSettings()
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
        self._until[pair] = now + min(self._settings.forget * 2.0 ** (times - 1), self._settings.longest)

    def at(self, now: float) -> tuple[Pair, ...]:
        """Pairs that count as blocked at a time, s."""
        return tuple(pair for pair, until in self._until.items() if now < until)

    def next_change(self, now: float) -> float:
        """Seconds until a block is forgotten; 0 without blocks."""
        return min((until - now for until in self._until.values() if now < until), default=0.0)
