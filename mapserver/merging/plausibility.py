"""Plausibility: what is in a map that no robot can have measured, in words.

Such a map is merged as far as its links carry it, but it is no second place: where it shows what other maps
show, and is not joined with them, it makes no answer ambiguous (mapweave.mapserver.active_nodes).
"""

from __future__ import annotations

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import CODE_BYTES, MapId, Node, NodeId
from mapweave.mapserver.retrieval.compared_landmarks import MOST_LANDMARKS
from mapweave.merge.mutual_exclusion.trajectories import runs_backwards

LEAST_COPIED = 10
"""Landmarks with the same descriptor, bit by bit: as many as a recognition needs. Two images of a thing never
give the same 32 numbers as often."""


def implausible(hybrid_map: HybridMap) -> str:
    """What no robot can have measured; empty if all of a map may be true."""
    nodes = sorted(hybrid_map.nodes.values(), key=lambda node: node.id)
    most = max(nodes, key=lambda node: len(node.landmarks), default=None)
    if most is not None and len(most.landmarks) > MOST_LANDMARKS:
        return f"node {most.id} has {len(most.landmarks)} landmarks, of which {MOST_LANDMARKS} are compared"
    for clock in sorted({node.clock for node in nodes} - {""}):
        if runs_backwards([node for node in nodes if node.clock == clock]):
            return f"its clock {clock} runs backwards: nothing is concluded from its times"
    return ""


def copied_landmarks(a: Node, b: Node) -> int:
    """How many descriptors two nodes have in common, bit by bit."""
    return len(_descriptors(a) & _descriptors(b))


def _descriptors(node: Node) -> set[bytes]:
    codes = node.landmarks.codes.tobytes()
    return {codes[k : k + CODE_BYTES] for k in range(0, len(codes), CODE_BYTES)}


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

    def compare(self, a: Node, b: Node) -> None:
        """Look for copies among two nodes that show the same place."""
        copied = copied_landmarks(a, b) if a.id.agent != b.id.agent else 0
        if copied >= LEAST_COPIED:
            self._pairs[a.id, b.id] = copied

    def forget(self, pair: tuple[NodeId, NodeId]) -> None:
        """Two nodes are no longer compared, or show different things now."""
        self._pairs.pop(pair, None)

    def maps(self, suspects: frozenset[MapId]) -> dict[MapId, str]:
        """The maps with copies, and what they copy, in words.

        Args:
            suspects: maps that were set apart when this process began.
        """
        shared: dict[str, set[str]] = {}
        for a, b in self._pairs:
            shared.setdefault(a.agent, set()).add(b.agent)
            shared.setdefault(b.agent, set()).add(a.agent)

        def copier(node: NodeId) -> tuple[bool, int, int]:
            return node.map in suspects, len(shared[node.agent]), self._came.get(node, 0)

        out: dict[MapId, str] = {}
        for pair, copied in sorted(self._pairs.items()):
            original, copy = sorted(pair, key=copier)
            out.setdefault(
                copy.map, f"{copied} landmarks of its node {copy} are those of {original} bit by bit: copies"
            )
        return out
