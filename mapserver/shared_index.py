"""A place index that one thread fills while others search it."""

from __future__ import annotations

import threading
from collections.abc import Collection

from hybridmap.node import Node, NodeId
from hybridmap.query import View
from mapserver.placeindex import PlaceIndex, PlaceIndexSettings


class SharedPlaceIndex(PlaceIndex):
    """The same index with one lock, held for a single node or search: milliseconds, never for a merge."""

    def __init__(self, settings: PlaceIndexSettings | None = None) -> None:
        """Start empty."""
        # A node is removed while it is added.
        self._turn = threading.RLock()
        super().__init__(settings)

    def add(self, node: Node) -> None:
        """Add a node, or replace it."""
        with self._turn:
            super().add(node)

    def remove(self, node_id: NodeId) -> None:
        """Forget a node. One that is not there is no error."""
        with self._turn:
            super().remove(node_id)

    def query(self, view: View, k: int = 5, exclude: Collection[NodeId] = ()) -> list[tuple[NodeId, float]]:
        """Rank nodes by how much they look like a view, best first."""
        with self._turn:
            return super().query(view, k, exclude)

    def overlaps(self, node: Node) -> dict[NodeId, float]:
        """Which nodes share how many alike descriptors with a node."""
        with self._turn:
            return super().overlaps(node)
