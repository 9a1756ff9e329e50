"""Which pairs of nodes are verified: those that are among the best of either of their nodes.

The table of all overlaps is never traversed. Only what a change affects is updated: the nodes whose overlaps
it contains, and the few edges around a new or removed edge.
"""

from collections import Counter
from collections.abc import Mapping

import networkx as nx

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.merge.pose_graph.candidates import LEAST_HOPS, LEAST_OVERLAP, MOST_PER_MAP, Pair


class PairTable:
    """Overlaps by node, the edges that make neighbours, and the pairs that are chosen."""

    def __init__(self, most_per_map: int = MOST_PER_MAP, least_hops: int = LEAST_HOPS) -> None:
        """Start empty.

        Args:
            most_per_map: best pairs of one node with the nodes of any one map.
            least_hops: nodes of one map that are fewer edges apart are neighbours, not loops.
        """
        self._most_per_map, self._least_hops = most_per_map, least_hops
        self._overlaps: dict[NodeId, dict[NodeId, float]] = {}
        self._edges: nx.MultiGraph = nx.MultiGraph()
        self._best: dict[NodeId, frozenset[Pair]] = {}
        self._votes: Counter[Pair] = Counter()
        self._stale: set[NodeId] = set()
        self._changed: set[Pair] = set()

    def put(self, node: NodeId, overlaps: Mapping[NodeId, float]) -> None:
        """Add a node's overlaps with others."""
        for neighbour, value in overlaps.items():
            self._overlaps.setdefault(node, {})[neighbour] = value
            self._overlaps.setdefault(neighbour, {})[node] = value
        self._stale |= {node, *overlaps}

    def overlaps(self) -> dict[Pair, float]:
        """All that are known, by (smaller id, greater id)."""
        return {
            (node, neighbour): value
            for node, by_node in self._overlaps.items()
            for neighbour, value in by_node.items()
            if node < neighbour
        }

    def overlaps_of(self, node: NodeId) -> dict[Pair, float]:
        """Those of one node, likewise."""
        by_node = self._overlaps.get(node, {})
        return {(min(node, other), max(node, other)): value for other, value in by_node.items()}

    def forget(self, node: NodeId) -> None:
        """Drop a node's overlaps: it is gone, or is known better."""
        for neighbour in self._overlaps.pop(node, ()):
            del self._overlaps[neighbour][node]
            self._stale.add(neighbour)
            self._choose(
                neighbour, frozenset(pair for pair in self._best.get(neighbour, ()) if node not in pair)
            )
        self._choose(node, frozenset())

    def connect(self, a: NodeId, b: NodeId) -> None:
        """Make two nodes neighbours, by an edge."""
        self._edges.add_edge(a, b)
        self._stale |= self._around(a) | self._around(b)

    def disconnect(self, a: NodeId, b: NodeId) -> None:
        """Remove such an edge."""
        self._stale |= self._around(a) | self._around(b)
        self._edges.remove_edge(a, b)
        self._edges.remove_nodes_from([end for end in {a, b} if not self._edges[end]])

    def of(self, node: NodeId) -> list[Pair]:
        """The chosen pairs of one node, in the order of ids."""
        overlaps = self._overlaps.get(node, {})
        for stale in self._stale & {node, *overlaps}:
            self._choose(stale, self._ranked(stale))
        self._stale -= {node, *overlaps}
        pairs = ((min(node, neighbour), max(node, neighbour)) for neighbour in overlaps)
        return sorted(pair for pair in pairs if self._votes[pair] > 0)

    @property
    def waiting(self) -> bool:
        """Whether there are pairs that `changed` will give."""
        self._choose_stale()
        return bool(self._changed)

    def changed(self) -> list[Pair]:
        """Pairs that were chosen, left out or forgotten since this was asked last, in the order of ids."""
        self._choose_stale()
        changed, self._changed = self._changed, set()
        return sorted(changed)

    def __contains__(self, pair: Pair) -> bool:
        """Whether a pair is chosen; ask for what has changed first."""
        return self._votes[pair] > 0

    def _ranked(self, node: NodeId) -> frozenset[Pair]:
        """The best pairs of a node with the nodes of each map."""
        overlaps = self._overlaps.get(node)
        if not overlaps:
            return frozenset()
        neighbours = self._around(node)
        by_map: dict[MapId, list[tuple[float, Pair]]] = {}
        for neighbour, value in overlaps.items():
            if value >= LEAST_OVERLAP and neighbour not in neighbours:
                pair = (node, neighbour) if node < neighbour else (neighbour, node)
                by_map.setdefault(neighbour.map, []).append((-value, pair))
        return frozenset(pair for best in by_map.values() for _, pair in sorted(best)[: self._most_per_map])

    def _choose_stale(self) -> None:
        for node in self._stale:
            self._choose(node, self._ranked(node))
        self._stale = set()

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
        if node not in self._edges:
            return {node}
        return {*nx.single_source_shortest_path_length(self._edges, node, self._least_hops - 1)}
