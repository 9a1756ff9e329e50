"""Edges that robots could not drive: routes of other robots avoid them."""

from __future__ import annotations

import threading
from collections.abc import Collection

from mapweave.hybridmap.ids import NodeId

FORGET = 120.0
"""How long a blockage counts after it was reported last, s."""
MOST = 256
"""Blockages that are kept, those that were reported last."""


Pair = tuple[NodeId, NodeId]


class Blockages:
    """Pairs of nodes between which some robot did not get through, with the time of its report. Thread-safe.

    A robot reports it with the question for its next route. That robot bars the pair for itself; for all
    others it
    only costs more: one robot's obstacle may have moved, and need not be in another's way.
    """

    def __init__(self, forget: float = FORGET, most: int = MOST) -> None:
        """Nothing is blocked."""
        self._forget, self._most = forget, most
        self._reported: dict[Pair, float] = {}
        self._turn = threading.Lock()

    def report(self, pairs: Collection[Pair], now: float) -> None:
        """Add pairs between which a robot could not drive.

        Args:
            pairs: of nodes, in either order.
            now: of the server's clock, s.
        """
        with self._turn:
            for a, b in pairs:
                pair = (a, b) if a <= b else (b, a)
                self._reported.pop(pair, None)
                self._reported[pair] = now
            while len(self._reported) > self._most:
                del self._reported[next(iter(self._reported))]

    def known(self, now: float) -> list[Pair]:
        """What still counts at a time of the server's clock, s."""
        forget = self._forget
        with self._turn:
            self._reported = {pair: stamp for pair, stamp in self._reported.items() if now - stamp < forget}
            return list(self._reported)
