"""Superseded nodes leave the place index, so that a new node costs the same on every drive.

A robot's nodes of today stay in it for the time being, superseded or not: while maps are being made, links
between all of them distinguish true merges from false ones.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

from mapweave.hybridmap.node import Node, NodeId
from mapweave.mapserver.retrieval import voting
from mapweave.mapserver.retrieval.place_index import PlaceIndex, bounded
from mapweave.merge.pose_graph.candidates import ALIKE, LEAST_OVERLAP, Pair
from mapweave.merge.pose_graph.pairs import PairTable

SETTLED = 3600.0
"""s on the robot's own clock after which a node is no longer of today."""
SECOND = 1_000_000_000


class SupersededNodes:
    """Keeps old superseded nodes out of the place index, but keeps their verdicts."""

    def __init__(self, index: PlaceIndex, pairs: PairTable, node_of: Callable[[NodeId], Node | None]) -> None:
        """Begin with nothing superseded.

        Args:
            index: of places that are searched.
            pairs: that are compared; nodes that become active again are put into it.
            node_of: gives a node by its id.
        """
        self._index, self._pairs, self._node_of = index, pairs, node_of
        self._left_out: set[NodeId] = set()
        self._newest: dict[str, tuple[int, int]] = {}

    def overlaps(self, node: Node, before: Iterable[Pair]) -> dict[NodeId, float]:
        """Which nodes a node is compared with: those in the index, and those left out that it was before.

        Args:
            node: has just come.
            before: pairs that it was in, if it was known already.
        """
        found = self._index.overlaps(node, self._node_of)
        for candidate_id in {node_id for pair in before for node_id in pair} & self._left_out:
            candidate = self._node_of(candidate_id)
            if candidate is not None and candidate_id != node.id:
                codes, candidate_codes = (bounded(node_id).landmarks.codes for node_id in (node, candidate))
                value = voting.pair_overlap(codes, candidate_codes, ALIKE)
                if value >= LEAST_OVERLAP:
                    found[candidate_id] = value
        return found

    def put(self, node: Node) -> None:
        """A node was added to the index, or written again."""
        self._left_out.discard(node.id)
        key = node.id.epoch, node.stamp_ns
        self._newest[node.id.agent] = max(key, self._newest.get(node.id.agent, key))

    def drop(self, node_id: NodeId) -> None:
        """Remove a node."""
        self._left_out.discard(node_id)

    def follow(self, superseded: Collection[NodeId]) -> None:
        """Set the superseded nodes."""
        past = {node_id for node_id in superseded if self._is_past(node_id)}
        for node_id in self._left_out - past:
            if (node := self._node_of(node_id)) is not None:
                self._index.add(node)
                self._pairs.put(node_id, self._index.overlaps(node, self._node_of))
        for node_id in past - self._left_out:
            node = self._node_of(node_id)
            self._index.remove(node_id, None if node is None else node.landmarks.codes)
        self._left_out = past

    def _is_past(self, node_id: NodeId) -> bool:
        """Whether its robot has a later epoch by now, or much later nodes."""
        node = self._node_of(node_id)
        if node is None:
            return True
        epoch, stamp_ns = self._newest.get(node_id.agent, (node_id.epoch, node.stamp_ns))
        return epoch > node_id.epoch or stamp_ns - node.stamp_ns > SETTLED * SECOND
