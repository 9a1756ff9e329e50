"""Cache of reachability: an edge is evaluated once, however many merged maps contain it."""

from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.reachability import Reachability, left, reachability_of


class ReachabilityCache:
    """Keeps the reachability of edges from merged map to merged map."""

    def __init__(self) -> None:
        self._cache: dict[EdgeId, tuple[tuple[object, ...], Reachability]] = {}

    def reach(self, edge: Edge, a: Node, b: Node, faded: Sequence[NDArray[np.bool_] | None]) -> Reachability:
        """Whether the servo could drive an edge.

        Args:
            edge: between the two.
            a: node at the edge's a.
            b: node at its b.
            faded: which landmarks of a and of b are faded: the servo cannot use them.
        """
        behind = (edge.a_from_b, a, b, *faded)
        cached = self._cache.get(edge.id)
        if cached is None or any(old is not new for old, new in zip(cached[0], behind, strict=True)):
            visible_edge = replace(edge, shared=left(edge.shared, a, b, faded))
            cached = behind, reachability_of(visible_edge, a, b)
            self._cache[edge.id] = cached
        return cached[1]

    def remove(self, nodes: Container[NodeId]) -> None:
        """Forget all edges at some nodes."""
        self._cache = {
            edge_id: (behind, reachability)
            for edge_id, (behind, reachability) in self._cache.items()
            if not any(isinstance(end, Node) and end.id in nodes for end in behind)
        }

    def forget(self, but: Container[EdgeId]) -> None:
        """Forget all edges but some."""
        self._cache = {edge_id: entry for edge_id, entry in self._cache.items() if edge_id in but}
