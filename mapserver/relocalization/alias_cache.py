"""Which nodes a node looks like, anywhere on the map: found out once, kept while both stay what they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.mapserver.relocalization.aliased_landmarks import (
    EXPLAINED_PX,
    AliasedLandmarks,
    same_place,
    unchanged,
    unexplained,
)
from mapweave.mapserver.relocalization.candidates import Retrieval
from mapweave.registration.matching import match
from mapweave.registration.recognition import Recognition, RecognitionSettings

Between = Callable[[NodeId, NodeId], Pose2 | None]
"""Pose `a_from_b` of two nodes on the merged map; None if that does not join them."""


@dataclass(frozen=True, eq=False)
class AliasedNode:
    """A node that looks like another one, and is not the same place as far as the map knows.

    Attributes:
        other: which.
        other_from_node: where the one would be, seen from it.
        landmarks: (K,) of the one that the other shows too.
        others: (K,) those of the other.
    """

    other: Node
    other_from_node: PoseGaussian
    landmarks: NDArray[np.int64]
    others: NDArray[np.int64]

    def turned_round(self, node: Node) -> AliasedNode:
        """The same, told of the other; of which node this was is not kept."""
        return AliasedNode(node, self.other_from_node.inverse(), self.others, self.landmarks)


@dataclass(frozen=True, eq=False)
class _Entry:
    """What was found out about a node: what looks like it, and what was left out, being the same place."""

    node: Node
    found: dict[NodeId, AliasedNode]
    same: tuple[NodeId, ...]


class AliasCache:
    """Remembers for each node which others it looks like.

    A node that comes later is entered with those that it looks like as soon as it is asked about itself.
    """

    def __init__(self, recognition: RecognitionSettings, candidates: int = 16) -> None:
        """Take when a place counts as recognised, and how many nodes are compared with one."""
        self._doubles, self._recognition, self._candidates = (
            AliasedLandmarks(recognition),
            recognition,
            candidates,
        )
        self._known: dict[NodeId, _Entry] = {}

    def compare(self, a: Node, b: Node) -> Recognition | None:
        """See Doubles.compare."""
        return self._doubles.compare(a, b)

    def forget(self) -> None:
        """Look for everything again: nodes that were hidden when it was looked for are there again."""
        self._known = {}

    def __contains__(self, node_id: NodeId) -> bool:
        """Whether this was found out of a node, as it is or as it was."""
        return node_id in self._known

    def knows(self, node: Node) -> bool:
        """Whether this was found out."""
        entry = self._known.get(node.id)
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
        """What looks like a node, and lies elsewhere on the map or on a part of it that nothing joins.

        Args:
            node: the one.
            index: finds what may look like it.
            node_of: gives a node by its id; None if it is gone.
            between: what the merged map says of two nodes.
        """
        entry = self._known.get(node.id)
        # What is gone, or is of a map that people have retired, is parted from nothing.
        parted = entry is not None and any(
            between(one, node.id) is None and node_of(one) is not None for one in entry.same
        )
        if entry is None or parted or not unchanged(entry.node, node):
            entry = self._search(node, index, node_of, between)
        alike = []
        for one in list(entry.found.values()):
            other, mapped = node_of(one.other.id), between(one.other.id, node.id)
            if other is None or not unchanged(one.other, other):
                continue
            if mapped is None or not same_place(mapped, one.other_from_node.mean):
                alike.append(one)
        return alike

    def _search(
        self,
        node: Node,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        between: Between,
    ) -> _Entry:
        """Look for it in the whole fleet."""
        s, found, same = self._recognition, dict[NodeId, AliasedNode](), []
        marks = node.landmarks
        view = View(marks.pixels, marks.codes, node.camera)
        for other_id, _ in index.query(view, self._candidates + 1):
            other = node_of(other_id)
            if other_id == node.id or other is None:
                continue
            pairs = match(other.landmarks.codes, marks.codes, s.matching)
            if len(pairs) < s.least_inliers:
                continue
            mapped = between(other_id, node.id)
            if mapped is not None:
                left = unexplained(other, pairs, marks.pixels, node.camera, mapped, EXPLAINED_PX)
                if left < s.least_inliers:
                    same.append(other_id)
                    continue
            likeness = self._doubles.compare(other, node)
            if likeness is not None:
                found[other_id] = AliasedNode(
                    other, likeness.node_from_robot, likeness.pairs[:, 1], likeness.pairs[:, 0]
                )
        entry = _Entry(node, found, tuple(same))
        self._known[node.id] = entry
        for one in found.values():
            known = self._known.get(one.other.id)
            if known is not None and unchanged(known.node, one.other) and node.id not in known.found:
                more = {**known.found, node.id: one.turned_round(node)}
                self._known[one.other.id] = replace(known, found=more)
        return entry
