"""Copies: nodes whose landmarks are other robots', bit by bit."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node

LEAST_COPIED = 10
"""Landmarks that are the same bit by bit: as many as a recognition needs."""


def copied_landmarks(a: Node, b: Node) -> int:
    """How many landmarks two nodes have in common, bit by bit: pixel, descriptor, depth and its sigma.

    Descriptors alone would not do: of a robot that parks within a millimetre of another one's node a tenth of
    them are the same. Depths are measured on the way, and no two ways are the same.
    """
    return len(_landmarks(a) & _landmarks(b))


def _landmarks(node: Node) -> set[bytes]:
    landmarks = node.landmarks
    columns = (landmarks.pixels, landmarks.codes, landmarks.depths[:, None], landmarks.depth_sigmas[:, None])
    rows = np.hstack([np.ascontiguousarray(column).view(np.uint8) for column in columns])
    return {row.tobytes() for row in rows[np.isfinite(landmarks.depths)]}


class Copies:
    """Nodes whose landmarks are copies of other robots': no views of their own, so no evidence.

    Who came later has copied; that is known of nodes that came to this process. Of the others, those of
    maps that were set apart before; else those of the robot that shares landmarks with more others.
    """

    def __init__(self) -> None:
        """None are known."""
        self._pairs: dict[tuple[NodeId, NodeId], int] = {}
        self._came: dict[NodeId, int] = {}
        self._count = 0

    def came(self, node: Node, before: Node | None) -> None:
        """Note when the landmarks of a node came.

        Args:
            node: as it is now.
            before: as it was; None if it is new.
        """
        if before is None or 2 * copied_landmarks(node, before) < len(node.landmarks):
            self._count += 1
            self._came[node.id] = self._count

    def gone(self, node_id: NodeId) -> None:
        """A node is there no longer."""
        self._came.pop(node_id, None)

    def compare(self, a: Node, b: Node) -> None:
        """Look for copies among two nodes that show the same place."""
        copied = copied_landmarks(a, b) if a.id.agent != b.id.agent else 0
        if copied >= LEAST_COPIED:
            self._pairs[a.id, b.id] = copied

    def forget(self, pair: tuple[NodeId, NodeId]) -> None:
        """Two nodes are no longer compared, or show different things now."""
        self._pairs.pop(pair, None)

    def maps(self, suspects: frozenset[MapId], linked: Collection[frozenset[MapId]] = ()) -> dict[MapId, str]:
        """The maps with copies, and what they copy, in words.

        Args:
            suspects: maps that were set apart when this process began.
            linked: pairs of maps that a person has linked: both are of one recording, say, and true.
        """
        pairs = {
            pair: copied for pair, copied in self._pairs.items() if {node.map for node in pair} not in linked
        }
        shared: dict[str, set[str]] = {}
        for a, b in pairs:
            shared.setdefault(a.agent, set()).add(b.agent)
            shared.setdefault(b.agent, set()).add(a.agent)

        def copier(node: NodeId) -> tuple[bool, int, int]:
            return node.map in suspects, len(shared[node.agent]), self._came.get(node, 0)

        out: dict[MapId, str] = {}
        for pair, copied in sorted(pairs.items()):
            original, copy = sorted(pair, key=copier)
            out.setdefault(
                copy.map, f"{copied} landmarks of its node {copy} are those of {original} bit by bit: copies"
            )
        return out
