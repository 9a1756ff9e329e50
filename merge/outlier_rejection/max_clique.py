"""Cliques: the best set of links in which all agree, and how many of a set have no node in common."""

from collections.abc import Sequence

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.merge.pose_graph.links import Link


def best_clique(agree: NDArray[np.bool_], weights: NDArray[np.int64], exact: int = 40) -> list[int]:
    """Indices, ascending, of the set in which all agree that has the greatest weight.

    Args:
        agree: (N, N) symmetric.
        weights: (N,) positive.
        exact: up to this N the answer is the best; beyond, grown greedily from each link.
    """
    n = len(weights)
    if agree[np.triu_indices(n, 1)].all():
        return list(range(n))
    if n <= exact:
        graph = nx.from_numpy_array(agree & ~np.eye(n, dtype=bool))
        nx.set_node_attributes(graph, dict(enumerate(weights.tolist())), "weight")
        return sorted(nx.max_weight_clique(graph)[0])
    best: list[int] = []
    support = (agree * weights).sum(axis=1) + weights
    order = np.argsort(-support, kind="stable")
    for seed in order:
        grown, open_ = [int(seed)], agree[seed].copy()
        open_[seed] = False
        for k in order:
            if open_[k]:
                grown.append(int(k))
                open_ &= agree[k]
                open_[k] = False
        if weights[grown].sum() > (weights[best].sum() if best else 0):
            best = sorted(grown)
    return best


def independent_links(links: Sequence[Link], enough: int) -> int:
    """How many links can be chosen of which no two have a node in common; it is not counted beyond enough."""
    used: set[NodeId] = set()
    chosen = 0
    for link in links:
        if used.isdisjoint(link.pair):
            used.update(link.pair)
            chosen += 1
            if chosen >= enough:
                return enough
    graph: nx.Graph = nx.Graph()
    graph.add_edges_from(link.pair for link in links)
    return min(len(nx.max_weight_matching(graph, maxcardinality=True)), enough)
