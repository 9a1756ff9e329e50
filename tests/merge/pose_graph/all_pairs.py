"""The choice of pairs from the overlaps of all nodes at once, which the choice by changes agrees with."""

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.descriptor import decode
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, Node
from mapweave.merge.pose_graph.candidates import ALIKE, LEAST_HOPS, LEAST_OVERLAP, MOST_PER_MAP, Pair
from mapweave.registration.matching import squared_distances


def overlap(
    rows: NDArray[np.int64], columns: NDArray[np.int64], squared: NDArray[Any], alike: float
) -> float:
    """Of two nodes alone, from all pairs of similar descriptors; see `voting.overlaps`."""
    weights = 1.0 - np.asarray(squared, dtype=np.float64) / alike**2
    sums = []
    for side in (rows, columns):
        best = np.zeros(int(side.max(initial=-1)) + 1)
        np.maximum.at(best, side, weights)
        sums.append(float(best.sum()))
    return min(sums)


def overlaps(nodes: Collection[Node]) -> dict[Pair, float]:
    """The table for nodes that are all there, by comparing every pair: exact, for some hundred nodes.

    Returns:
        Overlaps of at least `least_overlap` by (smaller id, greater id).
    """
    ordered = sorted(nodes, key=lambda node: node.id)
    vectors = [decode(node.landmarks.codes) for node in ordered]
    table: dict[Pair, float] = {}
    for i, a in enumerate(ordered):
        for j in range(i):
            squared = squared_distances(vectors[j], vectors[i])
            rows, columns = np.nonzero(squared < ALIKE**2)
            value = overlap(rows, columns, squared[rows, columns], ALIKE)
            if value >= LEAST_OVERLAP:
                table[ordered[j].id, a.id] = value
    return table


def choose_pairs(
    table: Mapping[Pair, float],
    edges: Iterable[Edge],
    most_per_map: int = MOST_PER_MAP,
    least_hops: int = LEAST_HOPS,
) -> list[Pair]:
    """Choose the pairs to verify.

    Args:
        table: overlaps by (smaller id, greater id).
        edges: of all maps; nodes that are few edges apart are left out.
        most_per_map: best pairs of one node with the nodes of any one map.
        least_hops: nodes of one map that are fewer edges apart are neighbours, not loops.

    Returns:
        Pairs that are among the best of either of their nodes, in the order of ids.
    """
    graph: nx.Graph = nx.Graph()
    graph.add_edges_from((edge.a, edge.b) for edge in edges)
    neighbours = {
        node: set(nx.single_source_shortest_path_length(graph, node, least_hops - 1)) for node in graph
    }
    ranked: dict[tuple[NodeId, Any], list[tuple[float, Pair]]] = {}
    for pair, value in table.items():
        a, b = pair
        if value < LEAST_OVERLAP or b in neighbours.get(a, ()):
            continue
        for first, second in ((a, b), (b, a)):
            ranked.setdefault((first, second.map), []).append((-value, pair))
    chosen = {pair for best in ranked.values() for _, pair in sorted(best)[:most_per_map]}
    return sorted(chosen)
