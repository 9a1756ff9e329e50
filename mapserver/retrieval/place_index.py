"""The place index: finds nodes that look like a view, by the descriptors of all landmarks of the fleet."""

import logging
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import CODE_BYTES, Node
from mapweave.hybridmap.query import View
from mapweave.mapserver.retrieval import voting
from mapweave.mapserver.retrieval.compared_landmarks import MOST_LANDMARKS, bounded
from mapweave.mapserver.retrieval.landmark_index import LandmarkIndex, LandmarkIndexSettings
from mapweave.mapserver.retrieval.ranking import NearestLandmarks, Ranked, rank
from mapweave.merge.pose_graph.candidates import ALIKE, LEAST_OVERLAP

log = logging.getLogger(__name__)

SLOT_BITS = 16
"""A landmark's id in the index: its node's slot, then its number in the node."""
AT_ONCE = 1024
"""Nodes that are taken in at once."""


@dataclass(frozen=True)
class PlaceIndexSettings:
    """How places are found.

    Attributes:
        landmarks: how landmarks are found.
        votes: descriptors of the fleet that each feature of a view votes for.
        compared: nodes of a large fleet that are compared with one whose overlaps are wanted.
    """

    landmarks: LandmarkIndexSettings = field(default_factory=LandmarkIndexSettings)
    votes: int = 16
    compared: int = 64


class Print(NamedTuple):
    """By what a node's codes are known.

    Attributes:
        digest: of them.
        landmarks: how many they are.
    """

    digest: int
    landmarks: int


class PlaceIndex:
    """Nodes by the descriptors of their landmarks. A node is searchable as soon as it is added.

    One thread may fill it while others search, each at the same time as others. Who announces nodes waits for
    no search: they are taken in by the next who searches while no other does, or who fills.
    """

    def __init__(self, settings: PlaceIndexSettings | None = None) -> None:
        self._settings = settings or PlaceIndexSettings()
        self._landmarks = LandmarkIndex(self._settings.landmarks)
        self._lock = self._landmarks.lock
        self._slots: dict[NodeId, int] = {}
        self._nodes: dict[int, NodeId] = {}
        self._prints: dict[int, Print] = {}
        self._next = 0
        self._announced: deque[Node] = deque()

    def __len__(self) -> int:
        with self._current():
            return len(self._slots)

    def __contains__(self, node_id: NodeId) -> bool:
        with self._current():
            return node_id in self._slots

    @property
    def landmarks(self) -> LandmarkIndex:
        """What the nodes' landmarks are in; their ids are slot << SLOT_BITS, plus their number."""
        return self._landmarks

    def announce(self, node: Node) -> None:
        """Add a node, or replace it, without waiting; any thread may do so."""
        self._announced.append(node)

    def add(self, node: Node) -> None:
        """Add a node, or replace it."""
        self.extend([node])

    def extend(self, nodes: Iterable[Node]) -> None:
        """Add nodes, or replace them; many at once cost less than one by one.

        A node that is there with the very same descriptors costs next to nothing.
        """
        rest = iter(nodes)
        while some := list(islice(rest, AT_ONCE)):
            with self._current(fills=True):
                self._take(some)

    def remove(self, node_id: NodeId, codes: NDArray[np.uint8] | None = None) -> None:
        """Forget a node. One that is not there is no error.

        Args:
            node_id: which.
            codes: (N, 32) of its landmarks, if they are known: they give its cells.
        """
        with self._current(fills=True):
            slot = self._slots.pop(node_id, None)
            if slot is not None:
                known = self._prints.pop(slot)
                del self._nodes[slot]
                # Others than those that are there would leave some behind.
                codes = None if codes is None else codes[:MOST_LANDMARKS]
                codes = codes if codes is not None and _fingerprint(codes) == known else None
                self._landmarks.remove(slot << SLOT_BITS, (slot + 1) << SLOT_BITS, codes)

    def query(self, view: View, k: int = 5, exclude: Collection[NodeId] = ()) -> Ranked:
        """Rank nodes by their similarity to a view, see mapweave.mapserver.retrieval.voting.votes.

        Args:
            view: the image's features.
            k: nodes wanted at most.
            exclude: nodes that are not wanted: others are ranked as if these were not there.

        Returns:
            Nodes with a positive score, best first.
        """
        return Ranked(self._ranked(view.codes, k, exclude))

    def nearest(self, codes: NDArray[np.uint8], count: int, wanted: int) -> NearestLandmarks:
        """The nearest landmarks of features, for an index that is one of several.

        Args:
            codes: (N, 32) of the features.
            count: landmarks of each.
            wanted: how many of all are not hidden; who asks leaves out those that are.
        """
        with self._current():
            if len(codes) == 0 or len(self._landmarks) == 0:
                return NearestLandmarks.none(len(codes), count)
            squared, ids = self._landmarks.nearest(codes, count, wanted=wanted)
            slots, owners = np.unique(ids >> SLOT_BITS, return_inverse=True)
            owners, first = owners.reshape(ids.shape), int(slots[0] < 0)
            nodes = tuple(self._nodes[slot] for slot in slots[first:].tolist())
        return NearestLandmarks(squared, owners - first, nodes)

    def _ranked(
        self, codes: NDArray[np.uint8], k: int, exclude: Collection[NodeId]
    ) -> list[tuple[NodeId, float]]:
        with self._current():
            if len(codes) == 0 or len(self._landmarks) == 0:
                return []
            hidden = [self._slots[node_id] for node_id in set(exclude) if node_id in self._slots]
            unwanted = (lambda ids: np.isin(ids >> SLOT_BITS, hidden)) if hidden else None
            wanted = len(self._landmarks) - sum(self._prints[slot].landmarks for slot in hidden)
            squared, ids = self._landmarks.nearest(codes, self._settings.votes, unwanted, wanted)
            # -1 belongs to no node, shifted too.
            return rank(squared, ids >> SLOT_BITS, self._nodes, k)

    def overlaps(self, node: Node, node_of: Callable[[NodeId], Node | None]) -> dict[NodeId, float]:
        """Overlaps of a node: shared similar descriptors, see mapweave.mapserver.retrieval.voting.

        Every overlap is exact. Up to `exact` landmarks all nodes are compared; of a larger fleet those that
        most landmarks vote for, see `query`.

        Args:
            node: may be in the index itself; it does not overlap with itself.
            node_of: gives another node by its id; one that it does not give is left out.

        Returns:
            Overlaps of at least `least_overlap`.
        """
        node = bounded(node)
        if len(node.landmarks) == 0:
            return {}
        with self._current():
            if len(self._landmarks) == 0:
                return {}
            alike = self._landmarks.within(node.landmarks.codes, ALIKE)
            if alike is not None:
                rows, squared, ids = alike
                columns, slots = ids & ((1 << SLOT_BITS) - 1), ids >> SLOT_BITS
                ranked, values = voting.overlaps(rows, columns, squared, slots, ALIKE, LEAST_OVERLAP)
                pairs = zip(ranked.tolist(), values.tolist(), strict=True)
                overlaps_by_node = {self._nodes[slot]: value for slot, value in pairs}
        if alike is None:
            return self._voted(node, node_of)
        overlaps_by_node.pop(node.id, None)
        return overlaps_by_node

    def _voted(self, node: Node, node_of: Callable[[NodeId], Node | None]) -> dict[NodeId, float]:
        codes = node.landmarks.codes
        ranked = self._ranked(codes, self._settings.compared, [node.id])
        known = [candidate for node_id, _ in ranked if (candidate := node_of(node_id)) is not None]
        values = voting.pair_overlaps(
            codes, [bounded(candidate).landmarks.codes for candidate in known], ALIKE, LEAST_OVERLAP
        )
        return {candidate.id: value for candidate, value in zip(known, values, strict=True) if value}

    @contextmanager
    def _current(self, fills: bool = False) -> Iterator[None]:
        """Lock the index to search or to fill it, with the nodes in it that were announced."""
        if fills or self._announced:
            with self._lock.writing(wait=fills) as alone:
                if alone:
                    self._take_announced()
                if fills:
                    yield
                    return
        with self._lock.reading():
            yield

    def _take_announced(self) -> None:
        while self._announced:
            node = self._announced.popleft()
            try:
                self._take([node])
            except Exception:  # it is put once more by who merges
                log.exception("node %s cannot be found yet", node.id)

    def _take(self, nodes: list[Node]) -> None:
        """Take in nodes at once."""
        codes, ids = [np.zeros((0, CODE_BYTES), np.uint8)], [np.zeros(0, np.int64)]
        for node in map(bounded, nodes):
            stored, seal = self._slots.get(node.id), _fingerprint(node.landmarks.codes)
            if stored is not None:
                if self._prints[stored] == seal:
                    continue
                self._put(codes, ids)
                self.remove(node.id)
            slot, self._next = self._next, self._next + 1
            self._slots[node.id], self._nodes[slot], self._prints[slot] = slot, node.id, seal
            codes.append(node.landmarks.codes)
            ids.append((np.int64(slot) << SLOT_BITS) + np.arange(len(node.landmarks), dtype=np.int64))
        self._put(codes, ids)

    def _put(self, codes: list[NDArray[np.uint8]], ids: list[NDArray[np.int64]]) -> None:
        """Take in what was collected, and empty the lists."""
        self._landmarks.add(np.concatenate(codes), np.concatenate(ids))
        del codes[1:], ids[1:]


def _fingerprint(codes: NDArray[np.uint8]) -> Print:
    """The fingerprint of a node's (N, 32) codes."""
    return Print(hash(codes.tobytes()), len(codes))
