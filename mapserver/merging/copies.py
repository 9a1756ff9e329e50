"""Copies: nodes whose landmarks are other robots', bit by bit or one for one."""

from collections.abc import Collection

import numpy as np

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.registration.matching import match

LEAST_COPIED = 10
"""Landmarks that are the same bit by bit: as many as a recognition needs."""
SAME_SHARE, SAME_PX = 0.9, 3.0
"""Nodes have their landmarks one for one if so many match, as a share of those of the richer node, each at
the same pixel within this. Robots that begin at the very same place, with noise of their own, have 0.65 to
0.79 (four rendered offices), and 0.65 at most from 6 mm on; copies with the noise of another view 0.94 and
more (95 in 100)."""
LEAST_SAME = 4
"""Nodes of one map that have their landmarks one for one with those of another map: so many are copies."""
LEAST_LANDMARKS = 20
"""Of either node: with fewer a share is chance."""


def copied_landmarks(a: Node, b: Node) -> int:
    """How many landmarks two nodes have in common, bit by bit: pixel, descriptor, depth and its sigma.

    Descriptors alone would not do: of a robot that parks within a millimetre of another one's node a tenth of
    them are the same. Depths are measured on the way, and no two ways are the same.
    """
    return len(_landmarks(a) & _landmarks(b))


def one_for_one(a: Node, b: Node) -> bool:
    """Whether nearly each landmark of two nodes is one of the other, at the same pixel.

    Two views are not, as far as was measured: which features are found, have a depth, and are kept differs
    from view to view.
    """
    fewer, more = sorted((len(a.landmarks), len(b.landmarks)))
    if fewer < max(SAME_SHARE * more, LEAST_LANDMARKS):
        return False
    in_a, in_b = match(a.landmarks.codes, b.landmarks.codes).T
    off = a.landmarks.pixels[in_a] - b.landmarks.pixels[in_b]
    return int((np.hypot(*off.T) < SAME_PX).sum()) >= SAME_SHARE * more


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
        self._pairs: dict[tuple[NodeId, NodeId], int] = {}
        self._same: set[tuple[NodeId, NodeId]] = set()
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
        if a.id.agent == b.id.agent:
            return
        copied = copied_landmarks(a, b)
        if copied >= LEAST_COPIED:
            self._pairs[a.id, b.id] = copied
        elif one_for_one(a, b):
            self._same.add((a.id, b.id))

    def forget(self, pair: tuple[NodeId, NodeId]) -> None:
        """Two nodes are no longer compared, or show different things now."""
        self._pairs.pop(pair, None)
        self._same.discard(pair)

    def maps(self, suspects: frozenset[MapId], linked: Collection[frozenset[MapId]] = ()) -> dict[MapId, str]:
        """The maps with copies, and what they copy, in words.

        Args:
            suspects: maps that were set apart when this process began.
            linked: pairs of maps that a person has linked: both are of one recording, say, and true.
        """
        some = sorted([*self._pairs, *self._often_the_same()])
        pairs = [pair for pair in some if {node.map for node in pair} not in linked]
        shared: dict[str, set[str]] = {}
        for a, b in pairs:
            shared.setdefault(a.agent, set()).add(b.agent)
            shared.setdefault(b.agent, set()).add(a.agent)

        def copier(node: NodeId) -> tuple[bool, int, int]:
            return node.map in suspects, len(shared[node.agent]), self._came.get(node, 0)

        out: dict[MapId, str] = {}
        for pair in pairs:
            original, copy = sorted(pair, key=copier)
            many = self._pairs.get(pair)
            out.setdefault(
                copy.map,
                f"its node {copy} has the landmarks of {original} one for one, and so have others: copies"
                if many is None
                else f"{many} landmarks of its node {copy} are those of {original} bit by bit: copies",
            )
        return out

    def _often_the_same(self) -> list[tuple[NodeId, NodeId]]:
        """Pairs of nodes with the same landmarks, of maps that have several."""
        nodes: dict[frozenset[MapId], set[NodeId]] = {}
        for a, b in self._same:
            nodes.setdefault(frozenset((a.map, b.map)), set()).add(min(a, b))
        return [(a, b) for a, b in self._same if len(nodes[frozenset((a.map, b.map))]) >= LEAST_SAME]
