"""The place database: the one owner of the place index. It builds and updates it; all others ask.

A node can be found as soon as it is announced. Superseded nodes of an earlier drive leave the index, so that
a new node costs the same on every drive. Nodes of today stay in it, superseded or not: while maps are being
made, links between all of them distinguish true merges from false ones.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.query import View
from mapweave.mapserver.retrieval import voting
from mapweave.mapserver.retrieval.compared_landmarks import bounded
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.mapserver.retrieval.ranking import Ranked
from mapweave.merge.pose_graph.candidates import ALIKE, LEAST_OVERLAP

SETTLED = 3600.0
"""s on the robot's own clock after which what it saw is no longer of today."""
SECOND = 1_000_000_000

NodeOf = Callable[[NodeId], Node | None]
"""Gives a node by its id; None if it is gone."""


class NodeIndex(Protocol):
    """What nodes are searched in: a PlaceIndex, or several as one (mapweave.mapserver.cluster)."""

    def __len__(self) -> int: ...

    def __contains__(self, node_id: NodeId) -> bool: ...

    def announce(self, node: Node) -> None:
        """Add a node, or replace it; any thread may do so, and a search does not hold it up."""

    def add(self, node: Node) -> None:
        """Add a node, or replace it."""

    def extend(self, nodes: Iterable[Node]) -> None:
        """Add nodes, or replace them."""

    def remove(self, node_id: NodeId, codes: NDArray[np.uint8] | None = None) -> None:
        """Forget a node; see `PlaceIndex.remove`."""

    def query(self, view: View, k: int = 5, exclude: Collection[NodeId] = ()) -> Ranked:
        """At most k nodes with their similarity to a view, best first."""

    def overlaps(self, node: Node, node_of: NodeOf) -> dict[NodeId, float]:
        """Overlaps of a node with those that are here; see `PlaceIndex.overlaps`."""


class PlaceDatabase:
    """Nodes by their landmarks, in memory.

    One thread, the merging one, changes it, but for `announce`; any thread may ask.
    """

    def __init__(self, index: NodeIndex | None = None) -> None:
        """Begin with no node.

        Args:
            index: empty, to be filled and asked instead of one of its own.
        """
        self._index: NodeIndex = PlaceIndex() if index is None else index
        self._left_out: set[NodeId] = set()
        self._newest: dict[str, tuple[int, int]] = {}

    # Ask.

    def __len__(self) -> int:
        return len(self._index)

    def __contains__(self, node_id: NodeId) -> bool:
        return node_id in self._index

    def query(self, view: View, k: int = 5, exclude: Collection[NodeId] = ()) -> Ranked:
        """At most k nodes with their similarity to a view, best first; see `PlaceIndex.query`."""
        return self._index.query(view, k, exclude)

    def overlaps(
        self, node: Node, node_of: NodeOf, before: Iterable[Sequence[NodeId]] = ()
    ) -> dict[NodeId, float]:
        """Which nodes a node is compared with, and by how much they overlap; see `PlaceIndex.overlaps`.

        Args:
            node: itself need not be in the database.
            node_of: gives another node by its id.
            before: pairs of nodes in which it was; of these also those that were left out are compared.
        """
        overlaps_by_node = self._index.overlaps(node, node_of)
        left_out = {node_id for pair in before for node_id in pair} & self._left_out - {node.id}
        known = [candidate for node_id in left_out if (candidate := node_of(node_id)) is not None]
        codes, *others = (bounded(compared).landmarks.codes for compared in (node, *known))
        values = voting.pair_overlaps(codes, others, ALIKE, LEAST_OVERLAP)
        overlaps_by_node |= {c.id: value for c, value in zip(known, values, strict=True) if value}
        return overlaps_by_node

    # Update.

    def announce(self, node: Node) -> None:
        """Let a node be found before it is put; any thread may do so, and no search holds it up."""
        self._index.announce(node)

    def observe(self, node: Node) -> None:
        """Take note of a node before it is put: what its robot saw long before is no longer of today."""
        self._left_out.discard(node.id)
        newest = node.id.epoch, node.stamp_ns
        self._newest[node.id.agent] = max(newest, self._newest.get(node.id.agent, newest))

    def put(self, nodes: Iterable[Node]) -> None:
        """Put nodes, or replace them; many at once cost less than one by one."""
        self._index.extend(nodes)

    def remove(self, node: Node | None, node_id: NodeId) -> None:
        """Forget a node for good.

        Args:
            node: as it was, if that is known: then it is found faster.
            node_id: its id.
        """
        self._left_out.discard(node_id)
        self._index.remove(node_id, None if node is None else node.landmarks.codes)

    def leave_out(self, superseded: Collection[NodeId], node_of: NodeOf) -> dict[NodeId, dict[NodeId, float]]:
        """Leave out the superseded nodes of earlier drives, and no others.

        Returns:
            The nodes that are taken in again, each with its overlaps.
        """
        past = {node_id for node_id in superseded if self._is_past(node_id, node_of)}
        revived = {}
        for node_id in sorted(self._left_out - past):
            if (node := node_of(node_id)) is not None:
                self._index.add(node)
                revived[node_id] = self._index.overlaps(node, node_of)
        for node_id in sorted(past - self._left_out):
            node = node_of(node_id)
            self._index.remove(node_id, None if node is None else node.landmarks.codes)
        self._left_out = past
        return revived

    def _is_past(self, node_id: NodeId, node_of: NodeOf) -> bool:
        """Whether its robot is in a later epoch by now, or was there long after it."""
        node = node_of(node_id)
        if node is None:
            return True
        epoch, stamp_ns = self._newest.get(node_id.agent, (node_id.epoch, node.stamp_ns))
        return epoch > node_id.epoch or stamp_ns - node.stamp_ns > SETTLED * SECOND
