"""Ways that robots could not drive, kept for the others: whoever asks for a route is led around them."""

from __future__ import annotations

import threading
from collections.abc import Collection

from mapweave.hybridmap.node import NodeId

FORGET = 120.0
"""How long a blockage counts after it was reported last, s; infinite where only simulated time passes,
which no server knows."""
MOST = 256
"""Blockages that are kept, those that were reported last."""


Pair = tuple[NodeId, NodeId]


class Blockages:
    """Pairs of nodes between which some robot did not get through, with when it said so. For any thread.

    A robot says it in the question for its next route. That robot bars the pair for itself; for all others
    it is only dear: what stood in one robot's way may have gone, and need not be in another's.
    """

    def __init__(self, forget: float = FORGET, most: int = MOST) -> None:
        """Nothing is blocked."""
        self._forget, self._most = forget, most
        self._said: dict[Pair, float] = {}
        self._turn = threading.Lock()

    def report(self, pairs: Collection[Pair], now: float) -> None:
        """A robot could not get through here.

        Args:
            pairs: of nodes, in either order.
            now: of the server's clock, s.
        """
        with self._turn:
            for a, b in pairs:
                pair = (a, b) if a <= b else (b, a)
                self._said.pop(pair, None)
                self._said[pair] = now
            while len(self._said) > self._most:
                del self._said[next(iter(self._said))]

    def known(self, now: float) -> list[Pair]:
        """What still counts at a time of the server's clock, s."""
        forget = self._forget
        with self._turn:
            self._said = {pair: said for pair, said in self._said.items() if now - said < forget}
            return list(self._said)
