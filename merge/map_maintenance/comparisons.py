"""Comparisons of nodes that the merge had no need of, each made once."""

from __future__ import annotations

from mapweave.hybridmap.node import Node, NodeId
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.verification import verify
from mapweave.registration.matching import match

MOST = 200_000
"""Comparisons that are remembered; then it begins anew."""


class Comparisons:
    """What was found of pairs of nodes, as long as the two are known just so."""

    def __init__(self) -> None:
        """Nothing is compared yet."""
        self._known: dict[tuple[NodeId, NodeId], tuple[Node, Node, Link | None]] = {}

    def link(self, a: Node, b: Node, least: int) -> Link | None:
        """A verified link; None if the two are not recognised as one place.

        Args:
            a: one node.
            b: another one.
            least: if fewer landmarks look alike, it is not looked any closer.
        """
        a, b = (a, b) if a.id < b.id else (b, a)
        known = self._known.get((a.id, b.id))
        if known is None or known[0] is not a or known[1] is not b:
            if len(self._known) >= MOST:
                self._known = {}
            known = self._known[a.id, b.id] = a, b, self._verified(a, b, least)
        return known[2]

    def _verified(self, a: Node, b: Node, least: int) -> Link | None:
        alike = match(a.landmarks.codes, b.landmarks.codes)
        verdict = verify(a, b) if len(alike) >= least else None
        return verdict if isinstance(verdict, Link) else None
