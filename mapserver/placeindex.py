"""Which nodes look like a view: a growing index over the descriptors of all landmarks of the fleet."""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from hybridmap.descriptor import decode, quantise
from hybridmap.landmark_tables import DIMENSIONS
from hybridmap.node import CODE_BYTES, Node, NodeId
from hybridmap.query import View
from mapserver.cells import Cells
from merge.candidates import CandidateSettings, overlap

log = logging.getLogger(__name__)

SLOT_BITS = 16
"""A landmark's id in the index: its node's slot, then its number in the node."""


@dataclass(frozen=True)
class PlaceIndexSettings:
    """How places are found.

    Attributes:
        candidates: what counts as alike and how much overlap is worth noting.
        votes: descriptors of the fleet that each feature of a view votes for.
        reach: distance of two decoded descriptors at which a vote counts nothing.
        small: up to as many landmarks every one is compared with a view; beyond, those of some cells.
        exact: up to as many landmarks overlaps are exact.
        growth: cells are learned anew when there are so many times as many landmarks.
        probes: cells that are searched for a feature of a view.
        overlap_probes: cells that are searched for a landmark of a node whose overlaps are wanted.
        patience: landmarks beyond which cells are learned beside the questions, not between them.
    """

    candidates: CandidateSettings = field(default_factory=CandidateSettings)
    votes: int = 32
    reach: float = 0.6
    small: int = 10_000
    exact: int = 300_000
    growth: float = 4.0
    probes: int = 8
    overlap_probes: int = 64
    patience: int = 1_000_000


class PlaceIndex:
    """Nodes by the looks of their landmarks. A node is searchable as soon as it is added.

    Landmarks are compared one by one while they are few. Then they are sorted into cells, which are learned
    anew as the fleet's map grows; until new ones are ready the old ones serve, with all that has come.
    """

    def __init__(self, settings: PlaceIndexSettings | None = None) -> None:
        """Start empty."""
        self._settings = settings or PlaceIndexSettings()
        self._flat: Any = faiss.IndexIDMap2(faiss.IndexFlatL2(DIMENSIONS))
        self._cells: Cells | None = None
        self._learned = 0
        self._learner: threading.Thread | None = None
        self._missed: list[tuple[NDArray[np.uint8], NDArray[np.int64]] | int] = []
        self._lock = threading.RLock()
        self._slots: dict[NodeId, int] = {}
        self._ids: dict[int, NodeId] = {}
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
        return len(self._cells) if self._cells is not None else int(self._flat.ntotal)

    def add(self, node: Node) -> None:
        """Add a node, or replace it."""
        self.extend([node])

    def extend(self, nodes: Iterable[Node]) -> None:
        """Add nodes, or replace them; many at once cost less than one by one."""
        codes, ids = [np.zeros((0, CODE_BYTES), np.uint8)], [np.zeros(0, np.int64)]
        with self._lock:
            for node in nodes:
                if node.id in self._slots:
                    self._put(codes, ids)
                    self.remove(node.id)
                slot, self._next = self._next, self._next + 1
                self._slots[node.id], self._ids[slot] = slot, node.id
                codes.append(node.landmarks.codes)
                ids.append((np.int64(slot) << SLOT_BITS) + np.arange(len(node.landmarks), dtype=np.int64))
            self._put(codes, ids)
            self._grow()

    def remove(self, node_id: NodeId) -> None:
        """Forget a node. One that is not there is no error."""
        with self._lock:
            slot = self._slots.pop(node_id, None)
            if slot is None:
                return
            del self._ids[slot]
            if self._learner is not None:
                self._missed.append(slot)
            first, last = slot << SLOT_BITS, (slot + 1) << SLOT_BITS
            if self._flat is not None:
                self._flat.remove_ids(faiss.IDSelectorRange(first, last))
            if self._cells is not None:
                self._cells.remove(first, last)

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
        with self._lock:
            if len(view) == 0 or self.landmarks == 0:
                return []
            squared, ids = self._nearest(view.codes)
            unwanted = [self._slots[node_id] for node_id in exclude if node_id in self._slots]
            weights = np.where(ids >= 0, 1.0 - squared / s.reach**2, 0.0)
            feature, place = np.nonzero(weights > 0)
            slots = ids[feature, place] >> SLOT_BITS
            # The nearest descriptor comes first, so the first vote of a feature for a node is its best.
            _, first = np.unique(feature * np.int64(self._next) + slots, return_index=True)
            feature, slots, votes = feature[first], slots[first], weights[feature[first], place[first]]
            votes = votes / np.sqrt(np.bincount(feature, minlength=len(view)))[feature]
            if not len(slots):
                return []
            found, which = np.unique(slots, return_inverse=True)
            scores = np.bincount(which, votes, minlength=len(found))
            scores[np.isin(found, unwanted)] = 0.0
            enough = np.sort(scores)[-min(k, len(scores)) :][:1]
            best = np.flatnonzero((scores > 0) & (scores >= enough))
            ranked = [(self._ids[int(found[i])], float(scores[i])) for i in best]
        return sorted(ranked, key=lambda item: (-item[1], item[0]))[:k]

    def overlaps(self, node: Node) -> dict[NodeId, float]:
        """Which nodes share how many alike descriptors with a node, see merge.candidates.

        Args:
            node: may be in the index itself; it does not overlap with itself.

        Returns:
            Overlaps of at least `least_overlap`, exact as long as there are at most `exact` landmarks.
        """
        s = self._settings.candidates
        with self._lock:
            if len(node.landmarks) == 0 or self.landmarks == 0:
                return {}
            rows, squared, ids = self._within(node.landmarks.codes, s.alike)
            slots, columns = ids >> SLOT_BITS, ids & ((1 << SLOT_BITS) - 1)
            order = np.argsort(slots, kind="stable")
            found: dict[NodeId, float] = {}
            for part in np.split(order, np.flatnonzero(np.diff(slots[order])) + 1):
                # A node with fewer hits than the least overlap cannot reach it.
                if len(part) < s.least_overlap:
                    continue
                other = self._ids[int(slots[part[0]])]
                value = overlap(rows[part], columns[part], squared[part], s.alike)
                if other != node.id and value >= s.least_overlap:
                    found[other] = value
        return found

    def settle(self) -> None:
        """Wait until cells that are being learned are in use."""
        learner = self._learner
        if learner is not None:
            learner.join()

    def _put(self, codes: list[NDArray[np.uint8]], ids: list[NDArray[np.int64]]) -> None:
        """Take in what was collected, and empty the lists."""
        many, numbers = np.concatenate(codes), np.concatenate(ids)
        del codes[1:], ids[1:]
        if not len(many):
            return
        if self._learner is not None:
            self._missed.append((many, numbers))
        if self._cells is not None:
            self._cells.add(many, numbers)
        if self._flat is not None:
            self._flat.add_with_ids(decode(many), numbers)

    def _nearest(self, codes: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """(N, k) squared distances and ids of the landmarks that features vote for."""
        s = self._settings
        k = min(s.votes, self.landmarks)
        if self._cells is not None:
            return self._cells.nearest(codes, k, s.probes)
        squared, ids = self._flat.search(decode(codes), k)
        return squared, ids

    def _within(
        self, codes: NDArray[np.uint8], reach: float
    ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64]]:
        """(M,) row of the code, squared distance and id of all landmarks that are alike."""
        if self._flat is None:
            assert self._cells is not None
            return self._cells.within(codes, reach, self._settings.overlap_probes)
        limits, squared, ids = self._flat.range_search(decode(codes), reach**2)
        return np.repeat(np.arange(len(codes)), np.diff(limits.astype(np.int64))), squared, ids

    def _grow(self) -> None:
        """Learn cells if there are many more landmarks than when it was last done."""
        s, n = self._settings, self.landmarks
        if n <= s.small or n < s.growth * self._learned or self._learner is not None:
            return
        codes, ids = self._contents()
        self._learned = n
        if n <= s.patience:
            self._missed = []
            self._swap(Cells(codes, ids, cells_for(n)))
            return
        self._missed = []
        self._learner = threading.Thread(target=self._learn, args=(codes, ids), name="cells", daemon=True)
        self._learner.start()

    def _learn(self, codes: NDArray[np.uint8], ids: NDArray[np.int64]) -> None:
        """In a thread of its own: make new cells, and hand over."""
        try:
            cells = Cells(codes, ids, cells_for(len(ids)))
        except Exception:  # the old cells go on serving, more slowly
            log.exception("the place index could not be made faster")
            cells = None
        with self._lock:
            if cells is not None:
                self._swap(cells)
            self._learner = None
            self._missed = []

    def _swap(self, cells: Cells) -> None:
        """Use new cells, with what came and went while they were learned."""
        for missed in self._missed:
            if isinstance(missed, int):
                cells.remove(missed << SLOT_BITS, (missed + 1) << SLOT_BITS)
            else:
                cells.add(*missed)
        self._cells = cells
        if len(cells) > self._settings.exact:
            self._flat = None

    def _contents(self) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """All codes and ids, in the order of the ids."""
        if self._cells is not None:
            return self._cells.contents()
        ids = faiss.vector_to_array(self._flat.id_map)
        vectors = self._flat.index.reconstruct_n(0, len(ids))
        order = np.argsort(ids, kind="stable")
        return quantise(vectors[order]), ids[order]


def cells_for(landmarks: int) -> int:
    """How many cells serve best from so many landmarks to a few times as many."""
    return int(2 ** round(np.log2(8.0 * np.sqrt(landmarks))))
