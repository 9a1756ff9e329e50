"""Cache of aliased nodes: which nodes look the same anywhere on the map, kept while both are unchanged."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.mapserver.relocalization.aliased_landmarks import (
    EXPLAINED_PX,
    alias,
    same_place,
    unchanged,
    unexplained,
)
from mapweave.mapserver.relocalization.candidates import Retrieval
from mapweave.mapserver.retrieval.ranking import IncompleteSearch
from mapweave.registration.matching import match
from mapweave.registration.recognition import RecognitionSettings

Between = Callable[[NodeId, NodeId], Pose2 | None]
"""Pose `a_from_b` of two nodes on the merged map; None if that does not join them."""


@dataclass(frozen=True, eq=False)
class AliasedNode:
    """A node that looks like another node, at a different place by the map.

    Attributes:
        other: which.
        other_from_node: relative pose that the similarity implies.
        landmarks: (K,) of the node that the other shows too.
        others: (K,) those of the other.
    """

    other: Node
    other_from_node: PoseGaussian
    landmarks: NDArray[np.int64]
    others: NDArray[np.int64]

    def turned_round(self, node: Node) -> AliasedNode:
        """The same from the other node's side."""
        return AliasedNode(node, self.other_from_node.inverse(), self.others, self.landmarks)


@dataclass(frozen=True, eq=False)
class _Entry:
    """Cached result of a node: its aliases, and candidates left out as the same place."""

    node: Node
    found: dict[NodeId, AliasedNode]
    same: tuple[NodeId, ...]


CANDIDATES = 16
"""How many nodes are compared with one."""


class AliasCache:
    """Caches the aliases of each node.

    A later node is entered with its aliases as soon as its own aliases are requested.
    """

    def __init__(self, recognition: RecognitionSettings) -> None:
        """Take when a place counts as recognised."""
        self._recognition = recognition
        self._entries: dict[NodeId, _Entry] = {}

    def forget(self) -> None:
        """Drop all results: nodes that were hidden at the search are active again."""
        self._entries = {}

    def remove(self, node_ids: Iterable[NodeId]) -> None:
        """Drop the results of nodes that are gone for good."""
        for node_id in node_ids:
            self._entries.pop(node_id, None)

    def __contains__(self, node_id: NodeId) -> bool:
        """Whether this was found out of a node, as it is or as it was."""
        return node_id in self._entries

    def knows(self, node: Node) -> bool:
        """Whether this was found out."""
        entry = self._entries.get(node.id)
        return entry is not None and unchanged(entry.node, node)

    def in_place(self, a: Node, b: Node, a_from_b: Pose2) -> int:
        """How many landmarks match, and lie where a pose has them."""
        marks = b.landmarks
        pairs = match(a.landmarks.codes, marks.codes, self._recognition.matching)
        return len(pairs) - unexplained(a, pairs, marks.pixels, b.camera, a_from_b, EXPLAINED_PX)

    def of(
        self,
        node: Node,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        between: Between,
    ) -> list[AliasedNode]:
        """Aliases of a node: elsewhere on the map, or on an unconnected part of it.

        Args:
            node: of which aliases are searched.
            index: finds candidates.
            node_of: gives a node by its id; None if it is gone.
            between: relative pose of two nodes in the merged map.

        Raises:
            IncompleteSearch: a part of the map cannot be searched now.
        """
        entry = self._entries.get(node.id)
        # What is gone, or is of a map that people have retired, is parted from nothing.
        parted = entry is not None and any(
            between(other, node.id) is None and node_of(other) is not None for other in entry.same
        )
        if entry is None or parted or not unchanged(entry.node, node):
            entry = self._search(node, index, node_of, between)
        alike = []
        for found in entry.found.values():
            aliased, mapped = node_of(found.other.id), between(found.other.id, node.id)
            if aliased is None or not unchanged(found.other, aliased):
                continue
            if mapped is None or not same_place(mapped, found.other_from_node.mean):
                alike.append(found)
        return alike

    def _search(
        self,
        node: Node,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        between: Between,
    ) -> _Entry:
        """Search the whole fleet; raises IncompleteSearch if a part of it is not to be had."""
        s, aliases, same = self._recognition, dict[NodeId, AliasedNode](), []
        marks = node.landmarks
        view = View(marks.pixels, marks.codes, node.camera)
        ranked = index.query(view, CANDIDATES + 1)
        if ranked.missing:
            # What is kept of a part of the map would pass for the whole of it later.
            raise IncompleteSearch(ranked.missing)
        for candidate_id, _ in ranked:
            candidate = node_of(candidate_id)
            if candidate_id == node.id or candidate is None:
                continue
            pairs = match(candidate.landmarks.codes, marks.codes, s.matching)
            if len(pairs) < s.least_inliers:
                continue
            mapped = between(candidate_id, node.id)
            if mapped is not None:
                left = unexplained(candidate, pairs, marks.pixels, node.camera, mapped, EXPLAINED_PX)
                if left < s.least_inliers:
                    same.append(candidate_id)
                    continue
            likeness = alias(candidate, node, s)
            if likeness is not None:
                aliases[candidate_id] = AliasedNode(
                    candidate, likeness.node_from_robot, likeness.pairs[:, 1], likeness.pairs[:, 0]
                )
        entry = _Entry(node, aliases, tuple(same))
        self._entries[node.id] = entry
        for found in aliases.values():
            other_entry = self._entries.get(found.other.id)
            if (
                other_entry is not None
                and unchanged(other_entry.node, found.other)
                and node.id not in other_entry.found
            ):
                more = {**other_entry.found, node.id: found.turned_round(node)}
                self._entries[found.other.id] = replace(other_entry, found=more)
        return entry
