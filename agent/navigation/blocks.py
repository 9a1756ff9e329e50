"""Where the robot could not drive, as pairs of nodes and as places; each is forgotten after a while."""

from typing import NamedTuple

from mapweave.agent.settings import NavigatorSettings
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.query import MAX_BLOCKED, MAX_OBSTACLES, Obstacle

Pair = tuple[NodeId, NodeId]


class _Block(NamedTuple):
    """Somewhere.

    Attributes:
        until: the pair counts until then, s.
        pair: of nodes, the smaller one first.
        obstacle: what is between them; None if that is not known.
        stays_until: the obstacle counts until then, s.
    """

    until: float
    pair: Pair
    obstacle: Obstacle | None
    stays_until: float


class Blocks:
    """The blocked edges, in the order in which they were found."""

    def __init__(self, settings: NavigatorSettings | None = None) -> None:
        """Start without blocks."""
        self._settings = settings or NavigatorSettings()
        self._blocks: list[_Block] = []
        self._lasted: dict[Pair, float] = {}

    def add(self, a: NodeId, b: NodeId, now: float, obstacle: Obstacle | None = None) -> None:
        """Add a pair between which the robot could not drive, in either direction.

        Args:
            a: one node.
            b: the other.
            now: s.
            obstacle: what keeps the robot from driving there, and from all edges past it. That of another
                robot counts for the longest time: the server knows when it has left.
        """
        s, pair = self._settings, (a, b) if a <= b else (b, a)
        lasts = 2.0 * self._lasted[pair] if pair in self._lasted else s.blocked_first
        lasts = self._lasted[pair] = min(lasts, s.blocked_longest)
        until = now + lasts
        stays = now + s.blocked_longest if obstacle is not None and obstacle.robot else until
        self._blocks = [block for block in self._blocks if now < block.stays_until and block.pair != pair]
        self._blocks.append(_Block(until, pair, obstacle, stays))

    def pairs(self, now: float) -> tuple[Pair, ...]:
        """Pairs that count as blocked at a time, s: the newest that a message holds."""
        return tuple(block.pair for block in self._blocks if now < block.until)[-MAX_BLOCKED:]

    def obstacles(self, now: float) -> tuple[Obstacle, ...]:
        """Likewise places."""
        held = (block.obstacle for block in self._blocks if now < block.stays_until)
        return tuple(obstacle for obstacle in held if obstacle is not None)[-MAX_OBSTACLES:]
