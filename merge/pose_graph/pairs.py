"""The choice of pairs as it changes: the same as `mapweave.merge.pose_graph.candidates.choose_pairs`, node
by node.

A table of all overlaps is never gone through. What a change can bear on is looked at alone: the nodes whose
overlaps it tells, and those few edges around an edge that comes or goes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from mapweave.hybridmap.node import MapId, NodeId
from mapweave.merge.pose_graph.candidates import LEAST_HOPS, LEAST_OVERLAP, MOST_PER_MAP, Pair


class PairTable:
    """Overlaps by node, the edges that make neighbours, and the pairs that are chosen."""

    def __init__(self, most_per_map: int = MOST_PER_MAP, least_hops: int = LEAST_HOPS) -> None:
        """Start empty; the arguments are those of `choose_pairs`."""
        self._most_per_map, self._least_hops = most_per_map, least_hops
        self._overlaps: dict[NodeId, dict[NodeId, float]] = {}
        self._ways: dict[NodeId, Counter[NodeId]] = {}
        self._best: dict[NodeId, frozenset[Pair]] = {}
        self._votes: Counter[Pair] = Counter()
        self._stale: set[NodeId] = set()
        self._changed: set[Pair] = set()

    def put(self, node: NodeId, overlaps: Mapping[NodeId, float]) -> None:
        """Take note of a node's overlaps with others, beside those that are known."""
        for other, value in overlaps.items():
            self._overlaps.setdefault(node, {})[other] = value
            self._overlaps.setdefault(other, {})[node] = value
        self._stale |= {node, *overlaps}

    def overlaps(self) -> dict[Pair, float]:
        """All that are known, by (smaller id, greater id)."""
        return {
            (node, other): value
            for node, others in self._overlaps.items()
            for other, value in others.items()
            if node < other
        }

    def forget(self, node: NodeId) -> None:
        """Drop a node's overlaps: it is gone, or is known better."""
        for other in self._overlaps.pop(node, ()):
            del self._overlaps[other][node]
            self._stale.add(other)
            self._choose(other, frozenset(pair for pair in self._best.get(other, ()) if node not in pair))
        self._choose(node, frozenset())

    def connect(self, a: NodeId, b: NodeId) -> None:
        """An edge says that two nodes are neighbours."""
        for one, other in ((a, b), (b, a)):
            self._ways.setdefault(one, Counter())[other] += 1
        self._stale |= self._around(a) | self._around(b)

    def disconnect(self, a: NodeId, b: NodeId) -> None:
        """An edge says so no longer."""
        self._stale |= self._around(a) | self._around(b)
        for one, other in ((a, b), (b, a)):
            ways = self._ways[one]
            ways[other] -= 1
            if not ways[other]:
                del ways[other]

    def of(self, node: NodeId) -> list[Pair]:
        """The pairs of one node that are chosen as things stand, in the order of ids."""
        others = self._overlaps.get(node, {})
        for one in self._stale & {node, *others}:
            self._choose(one, self._ranked(one))
        self._stale -= {node, *others}
        pairs = ((min(node, other), max(node, other)) for other in others)
        return sorted(pair for pair in pairs if self._votes[pair] > 0)

    def changed(self) -> list[Pair]:
        """Pairs that were chosen, left out or forgotten since this was asked last, in the order of ids."""
        for node in self._stale:
            self._choose(node, self._ranked(node))
        self._stale = set()
        changed, self._changed = self._changed, set()
        return sorted(changed)

    def __contains__(self, pair: Pair) -> bool:
        """Whether a pair is chosen; ask for what has changed first."""
        return self._votes[pair] > 0

    def _ranked(self, node: NodeId) -> frozenset[Pair]:
        """The best pairs of a node with the nodes of each map."""
        others = self._overlaps.get(node)
        if not others:
            return frozenset()
        near = self._around(node)
        by_map: dict[MapId, list[tuple[float, Pair]]] = {}
        for other, value in others.items():
            if value >= LEAST_OVERLAP and other not in near:
                pair = (node, other) if node < other else (other, node)
                by_map.setdefault(other.map, []).append((-value, pair))
        return frozenset(pair for best in by_map.values() for _, pair in sorted(best)[: self._most_per_map])

    def _choose(self, node: NodeId, pairs: frozenset[Pair]) -> None:
        """Let a node vote for these pairs, and for no others."""
        before = self._best.pop(node, frozenset())
        if pairs:
            self._best[node] = pairs
        for pair in pairs - before:
            self._votes[pair] += 1
            if self._votes[pair] == 1:
                self._changed.add(pair)
        for pair in before - pairs:
            self._votes[pair] -= 1
            if not self._votes[pair]:
                del self._votes[pair]
                self._changed.add(pair)

    def _around(self, node: NodeId) -> set[NodeId]:
        """Nodes that are few edges away, the node itself too."""
        found, ring = {node}, [node]
        for _ in range(self._least_hops - 1):
            ring = [other for one in ring for other in self._ways.get(one, ()) if other not in found]
            found.update(ring)
        return found
