"""Edges that robots could not drive: routes of other robots avoid them."""

import threading
from collections.abc import Collection

from mapweave.hybridmap.ids import NodeId

FORGET = 120.0
"""How long a blockage counts after it was reported last, s."""
MOST = 256
"""Blockages that are kept; beyond that the oldest of the robot that has most go first."""


Pair = tuple[NodeId, NodeId]


class Blockages:
    """Pairs of nodes between which some robot did not get through, with the time of its report. Thread-safe.

    A robot reports it with the question for its next route. That robot bars the pair for itself; for all
    others it
    only costs more: one robot's obstacle may have moved, and need not be in another's way.
    """

    def __init__(self, forget: float = FORGET, most: int = MOST) -> None:
        self._forget, self._most = forget, most
        self._reported: dict[str, dict[Pair, float]] = {}
        self._turn = threading.Lock()

    def report(self, pairs: Collection[Pair], now: float, robot: str = "") -> None:
        """Add pairs between which a robot could not drive.

        Args:
            pairs: of nodes, in either order.
            now: of the server's clock, s.
            robot: its name; empty if it has given none.
        """
        with self._turn:
            own = self._reported.setdefault(robot, {})
            for a, b in pairs:
                pair = (a, b) if a <= b else (b, a)
                own.pop(pair, None)
                own[pair] = now
            over = sum(map(len, self._reported.values())) - self._most
            for _ in range(over):
                # One robot that reports without end displaces its own.
                largest = max(self._reported.values(), key=len)
                del largest[next(iter(largest))]
            self._reported = {name: some for name, some in self._reported.items() if some}

    def known(self, now: float) -> list[Pair]:
        """What still counts at a time of the server's clock, s; each once, that of the last report last."""
        forget = self._forget
        with self._turn:
            kept = (
                (name, {pair: stamp for pair, stamp in some.items() if now - stamp < forget})
                for name, some in self._reported.items()
            )
            self._reported = {name: some for name, some in kept if some}
            last: dict[Pair, float] = {}
            for some in self._reported.values():
                for pair, stamp in some.items():
                    last[pair] = max(stamp, last.get(pair, stamp))
            return sorted(last, key=lambda pair: last[pair])
