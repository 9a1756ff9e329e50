"""Reachability that was worked out before: an edge is looked at once, however many maps it comes in."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import Edge, EdgeId, Node
from mapweave.hybridmap.reachability import Reachability, left, reachability_of


class ReachabilityCache:
    """What was found out of edges, from merged map to merged map: an edge is looked at once."""

    def __init__(self) -> None:
        """Start with nothing known."""
        self._known: dict[EdgeId, tuple[tuple[object, ...], Reachability]] = {}

    def reach(self, edge: Edge, a: Node, b: Node, gone: Sequence[NDArray[np.bool_] | None]) -> Reachability:
        """Whether the servo could drive an edge.

        Args:
            edge: between the two.
            a: node at the edge's a.
            b: node at its b.
            gone: which landmarks of a and of b are thought to be gone: these hold no servo.
        """
        behind = (edge.a_from_b, a, b, *gone)
        known = self._known.get(edge.id)
        if known is None or any(one is not other for one, other in zip(known[0], behind, strict=True)):
            seen = replace(edge, shared=left(edge.shared, a, b, gone))
            known = behind, reachability_of(seen, a, b)
            self._known[edge.id] = known
        return known[1]

    def forget(self, but: Container[EdgeId]) -> None:
        """Forget what is known of all edges but some."""
        self._known = {edge_id: known for edge_id, known in self._known.items() if edge_id in but}
