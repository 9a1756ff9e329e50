"""Succession: superseded nodes leave the place index, so that a new node costs the same on every drive."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

from hybridmap.node import Node, NodeId
from mapserver import tally
from mapserver.placeindex import PlaceIndex
from merge.candidates import Pair
from merge.incremental_pairs import PairTable


class Succession:
    """Keeps the place index to living nodes. What superseded ones were compared with is kept."""

    def __init__(self, index: PlaceIndex, pairs: PairTable, node_of: Callable[[NodeId], Node | None]) -> None:
        """Begin with nothing superseded.

        Args:
            index: of the living nodes.
            pairs: that are compared; revived nodes are put into it.
            node_of: gives a node by its id.
        """
        self._index, self._pairs, self._node_of = index, pairs, node_of
        self._superseded: set[NodeId] = set()

    def overlaps(self, node: Node, before: Iterable[Pair]) -> dict[NodeId, float]:
        """Which nodes a node is compared with: living ones, and those superseded ones that it was before.

        Args:
            node: has just come.
            before: pairs that it was in, if it was known already.
        """
        found, s = self._index.overlaps(node, self._node_of), self._index.settings.candidates
        for other_id in {one for pair in before for one in pair} & self._superseded:
            other = self._node_of(other_id)
            if other is not None and other_id != node.id:
                value = tally.pair_overlap(node.landmarks.codes, other.landmarks.codes, s.alike)
                if value >= s.least_overlap:
                    found[other_id] = value
        return found

    def replaced(self, node_id: NodeId) -> None:
        """A node has been put anew, and into the index, or has gone."""
        self._superseded.discard(node_id)

    def follow(self, superseded: Collection[NodeId]) -> None:
        """These nodes are superseded from now on, and no others."""
        for node_id in self._superseded - set(superseded):
            if (node := self._node_of(node_id)) is not None:
                self._index.add(node)
                self._pairs.put(node_id, self._index.overlaps(node, self._node_of))
        for node_id in set(superseded) - self._superseded:
            node = self._node_of(node_id)
            self._index.remove(node_id, None if node is None else node.landmarks.codes)
        self._superseded = set(superseded)
