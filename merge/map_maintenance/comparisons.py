"""Comparisons of nodes that the merge had no need of, each made once."""

from collections.abc import Container

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.verification import verify
from mapweave.registration.matching import match

MOST = 200_000
"""Comparisons that are cached; then the cache is emptied."""


class Comparisons:
    """What was found of pairs of nodes, as long as the two are known just so."""

    def __init__(self) -> None:
        self._cache: dict[tuple[NodeId, NodeId], tuple[Node, Node, Link | None]] = {}

    def link(self, a: Node, b: Node, least: int) -> Link | None:
        """A verified link; None if the two are not recognised as one place.

        Args:
            a: one node.
            b: another one.
            least: with fewer similar landmarks the nodes are not verified.
        """
        a, b = (a, b) if a.id < b.id else (b, a)
        entry = self._cache.get((a.id, b.id))
        if entry is None or entry[0] is not a or entry[1] is not b:
            if len(self._cache) >= MOST:
                self._cache = {}
            entry = self._cache[a.id, b.id] = a, b, self._verified(a, b, least)
        return entry[2]

    def forget(self, nodes: Container[NodeId]) -> None:
        """Drop what was found of some nodes: they are gone, and their landmarks with them."""
        self._cache = {
            pair: entry
            for pair, entry in self._cache.items()
            if pair[0] not in nodes and pair[1] not in nodes
        }

    def _verified(self, a: Node, b: Node, least: int) -> Link | None:
        alike = match(a.landmarks.codes, b.landmarks.codes)
        verdict = verify(a, b) if len(alike) >= least else None
        return verdict if isinstance(verdict, Link) else None
