"""Cliques: the best set of links in which all agree, and how many of a set have no node in common."""

from __future__ import annotations

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
        return _Search(agree, weights).best()
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


class _Search:
    """The heaviest clique by branch and bound (Warren and Hicks 2006), in the order of NetworkX's search.

    Sets of up to a few dozen members are the bits of a number, the members in descending order of how many
    agree with them.
    """

    def __init__(self, agree: NDArray[np.bool_], weights: NDArray[np.int64]) -> None:
        """Sort the members; see best_clique."""
        agree = agree & ~np.eye(len(weights), dtype=bool)
        order = np.argsort(-agree.sum(axis=1), kind="stable")
        self._members: list[int] = order.tolist()
        self._weights: list[int] = weights[order].tolist()
        packed = np.packbits(agree[np.ix_(order, order)], axis=1, bitorder="little")
        self._agreeing = [int.from_bytes(row.tobytes(), "little") for row in packed]
        self._all = (1 << len(order)) - 1
        # A member contradicts all that neither agree with it nor are itself.
        self._contradicting = [self._all & ~mask & ~(1 << k) for k, mask in enumerate(self._agreeing)]
        self._best, self._heaviest = 0, 0

    def best(self) -> list[int]:
        """Indices of the heaviest clique, ascending."""
        self._expand(0, 0, self._all)
        return sorted(member for k, member in enumerate(self._members) if self._best >> k & 1)

    def _expand(self, chosen: int, weight: int, open_: int) -> None:
        """Look for the best clique of all that are chosen and some of those that agree with all of them."""
        if weight > self._heaviest:
            self._best, self._heaviest = chosen, weight
        branches = self._branches(open_, self._heaviest - weight)
        while branches:
            k = branches.bit_length() - 1
            branches ^= 1 << k
            open_ ^= 1 << k
            self._expand(chosen | 1 << k, weight + self._weights[k], open_ & self._agreeing[k])

    def _branches(self, open_: int, target: int) -> int:
        """Those of which one is in any clique among the open ones that is heavier than the target.

        The others are covered by sets in which all contradict each other, which weigh no more than that: a
        clique takes one of each.
        """
        left, contradicting = self._weights[:], self._contradicting
        while open_:
            rest, apart = open_, list[int]()
            while rest:
                k = (rest & -rest).bit_length() - 1
                apart.append(k)
                rest &= contradicting[k]
            lightest = min([left[k] for k in apart])
            target -= lightest
            if target < 0:
                return open_
            for k in apart:
                left[k] -= lightest
                if not left[k]:
                    open_ ^= 1 << k
        return 0


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
