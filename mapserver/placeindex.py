"""Which nodes look like a view: a growing index over the descriptors of all landmarks of the fleet."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from hybridmap.descriptor import decode
from hybridmap.landmark_tables import DIMENSIONS
from hybridmap.node import Node, NodeId
from hybridmap.query import View
from merge.candidates import CandidateSettings, overlap

SLOT_BITS = 16
"""A landmark's id in the index: its node's slot, then its number in the node."""


@dataclass(frozen=True)
class PlaceIndexSettings:
    """How places are found.

    Attributes:
        candidates: what counts as alike and how much overlap is worth noting.
        votes: descriptors of the fleet that each feature of a view votes for.
        reach: distance of two decoded descriptors at which a vote counts nothing.
        exact: up to as many landmarks the search is exhaustive; beyond, cells are searched.
        probes: share of the cells that is searched then.
    """

    candidates: CandidateSettings = field(default_factory=CandidateSettings)
    votes: int = 32
    reach: float = 0.6
    exact: int = 300_000
    probes: float = 0.06


class PlaceIndex:
    """Nodes by the looks of their landmarks. A node is searchable as soon as it is added."""

    def __init__(self, settings: PlaceIndexSettings | None = None) -> None:
        """Start empty."""
        self._settings = settings or PlaceIndexSettings()
        self._flat = True
        self._index: Any = faiss.IndexIDMap2(faiss.IndexFlatL2(DIMENSIONS))
        self._slots: dict[NodeId, int] = {}
        self._nodes: dict[int, Node] = {}
        self._next = 0

    def __len__(self) -> int:
        """How many nodes."""
        return len(self._slots)

    def __contains__(self, node_id: NodeId) -> bool:
        """Whether a node is in the index."""
        return node_id in self._slots

    @property
    def landmarks(self) -> int:
        """How many landmarks."""
        return int(self._index.ntotal)

    def add(self, node: Node) -> None:
        """Add a node, or replace it."""
        self.remove(node.id)
        slot, self._next = self._next, self._next + 1
        self._slots[node.id], self._nodes[slot] = slot, node
        if len(node.landmarks):
            self._index.add_with_ids(decode(node.landmarks.codes), _ids(slot, node))
        if self._flat and self.landmarks > self._settings.exact:
            self._make_cells()

    def remove(self, node_id: NodeId) -> None:
        """Forget a node. One that is not there is no error."""
        slot = self._slots.pop(node_id, None)
        if slot is None:
            return
        node = self._nodes.pop(slot)
        if len(node.landmarks):
            self._index.remove_ids(_ids(slot, node))

    def query(self, view: View, k: int = 5, exclude: Collection[NodeId] = ()) -> list[tuple[NodeId, float]]:
        """Rank nodes by how much they look like a view.

        Each feature votes for the nodes of its nearest descriptors, by nearness and once a node. What it
        has to give is divided by the root of the number of nodes it votes for, as rare words weigh more in
        a text; a feature that half the fleet sees says little about where it is.

        Args:
            view: the image's features.
            k: nodes wanted at most.
            exclude: nodes that are not wanted.

        Returns:
            Nodes with a positive score, best first.
        """
        s = self._settings
        if len(view) == 0 or self.landmarks == 0:
            return []
        squared, ids = self._index.search(decode(view.codes), min(s.votes, self.landmarks))
        weights = np.where(ids >= 0, 1.0 - squared / s.reach**2, 0.0)
        feature, place = np.nonzero(weights > 0)
        slots = ids[feature, place] >> SLOT_BITS
        # The nearest descriptor comes first, so the first vote of a feature for a node is its best.
        _, first = np.unique(feature * np.int64(self._next) + slots, return_index=True)
        feature, slots, votes = feature[first], slots[first], weights[feature[first], place[first]]
        votes = votes / np.sqrt(np.bincount(feature, minlength=len(view)))[feature]
        scores = np.bincount(slots, votes, minlength=self._next)
        unwanted = [self._slots[node_id] for node_id in exclude if node_id in self._slots]
        scores[unwanted] = 0.0
        found = [(self._nodes[int(slot)].id, float(scores[slot])) for slot in np.flatnonzero(scores > 0)]
        return sorted(found, key=lambda item: (-item[1], item[0]))[:k]

    def overlaps(self, node: Node) -> dict[NodeId, float]:
        """Which nodes share how many alike descriptors with a node, see merge.candidates.

        Args:
            node: may be in the index itself; it does not overlap with itself.

        Returns:
            Overlaps of at least `least_overlap`. While the search is exhaustive they are exact.
        """
        s = self._settings.candidates
        if len(node.landmarks) == 0 or self.landmarks == 0:
            return {}
        limits, squared, ids = self._index.range_search(decode(node.landmarks.codes), s.alike**2)
        rows = np.repeat(np.arange(len(node.landmarks)), np.diff(limits.astype(np.int64)))
        slots, columns = ids >> SLOT_BITS, ids & ((1 << SLOT_BITS) - 1)
        order = np.argsort(slots, kind="stable")
        found: dict[NodeId, float] = {}
        for part in np.split(order, np.flatnonzero(np.diff(slots[order])) + 1):
            # A node with fewer hits than the least overlap cannot reach it.
            if len(part) < s.least_overlap:
                continue
            other = self._nodes[int(slots[part[0]])].id
            value = overlap(rows[part], columns[part], squared[part], s.alike)
            if other != node.id and value >= s.least_overlap:
                found[other] = value
        return found

    def _make_cells(self) -> None:
        """Go over to an inverted file whose cells are learned from the fleet's own landmarks."""
        ordered = sorted(self._nodes.items())
        vectors = np.concatenate([decode(node.landmarks.codes) for _, node in ordered])
        ids = np.concatenate([_ids(slot, node) for slot, node in ordered])
        cells = int(2 * np.sqrt(len(vectors)))
        index = faiss.IndexIVFFlat(faiss.IndexFlatL2(DIMENSIONS), DIMENSIONS, cells)
        index.cp.seed = 1234
        index.train(vectors[:: max(len(vectors) // (64 * cells), 1)])
        index.nprobe = max(int(self._settings.probes * cells), 1)
        index.add_with_ids(vectors, ids)
        self._index, self._flat = index, False


def _ids(slot: int, node: Node) -> NDArray[Any]:
    return (np.int64(slot) << SLOT_BITS) + np.arange(len(node.landmarks), dtype=np.int64)
