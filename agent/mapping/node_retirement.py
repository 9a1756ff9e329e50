"""Nodes of a robot's own map that newer ones have superseded for long: they leave it, so that it stays small.

The rule is that of the server (mapweave.hybridmap.superseding), by what the robot itself has measured: a
loop closure with a newer node, or many later views around. What supersedes a node has stood for two weeks,
as with a server. A fleet's server marginalises such a node first; only what it has let go does the robot
retire, so a node that people have named stays, and so does what it measured.
"""

from collections import deque
from collections.abc import Callable, Container

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.reachability import FARTHEST, RECOGNISED, left
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.hybridmap.superseding import (
    CROWD,
    DETOUR,
    LATER,
    SECOND,
    WAY,
    in_basin,
    is_candidate,
    reaches,
    superseded_by,
    within,
)

KEPT = 14 * 86_400 * SECOND
"""A node stays until one that supersedes it is so old, ns: as long as a server keeps superseded nodes."""
EVERY = 3600 * SECOND
"""Between two searches, ns on the robot's clock."""

Released = Callable[[NodeId, NodeId], bool]
"""Whether the fleet can do without a node; the other one supersedes it."""


def alone(node: NodeId, successor: NodeId) -> bool:
    """The retirement of a robot that shares its map with no fleet."""
    return True


class NodeRetirement:
    """Finds nodes that may leave. No call examines more than one: a robot's loop must not wait."""

    def __init__(self, own_map: HybridMap, released: Released = alone) -> None:
        """Nothing is examined yet.

        Args:
            own_map: of the robot; it is read alone.
            released: by the fleet.
        """
        self._map, self._released = own_map, released
        self._reaches = ReachabilityCache()
        self._candidates: deque[NodeId] = deque()
        self._successors: set[NodeId] = set()
        self._searched_ns: int | None = None

    def next(self, now_ns: int, held: Container[NodeId] = ()) -> NodeId | None:
        """Examine one node, and return it if it may leave.

        Args:
            now_ns: on the clock by which nodes are stamped.
            held: nodes that are in use.
        """
        if not self._candidates:
            before = self._searched_ns
            # A clock that was put back must not hold it up.
            if before is None or not 0 <= now_ns - before < EVERY:
                self._search(now_ns)
            return None
        node = self._map.nodes.get(self._candidates.popleft())
        if node is None or node.id in held or node.id in self._successors:
            return None
        successor = self._successor(node, now_ns) or self._crowding(node, now_ns)
        if successor is None or not self._spare(node, successor):
            return None
        # What supersedes another node stays at least until the next search.
        self._successors.add(successor.id)
        self._reaches.remove((node.id,))
        return node.id

    def _search(self, now_ns: int) -> None:
        """Line up what is old enough, the oldest first. The first node of a map gives it its frame."""
        first = min(self._map.nodes, default=None)
        old = (node.id for node in self._map.nodes.values() if now_ns - node.stamp_ns >= KEPT)
        self._candidates = deque(sorted(node for node in old if node != first))
        self._successors = set()
        self._searched_ns = now_ns

    def _edges(self, node: NodeId) -> list[tuple[Edge, Node]]:
        """Edges at a node, each with the own node at its other end."""
        ends = [(edge, edge.b if edge.a == node else edge.a) for edge in self._map.edges_at(node)]
        return [(edge, self._map.nodes[end]) for edge, end in ends if end != node and end in self._map.nodes]

    def _successor(self, node: Node, now_ns: int) -> Node | None:
        """The nearest newer node that supersedes a node."""
        loops = [
            (edge.a_from_b.mean.distance(Pose2()), other.id, edge, other)
            for edge, other in self._edges(node.id)
            if edge.kind is EdgeKind.LOOP and node.id < other.id and now_ns - other.stamp_ns >= KEPT
        ]
        for _, _, edge, other in sorted(loops, key=lambda loop: loop[:2]):
            forth = edge.a == node.id
            between = edge.a_from_b.mean if forth else edge.a_from_b.mean.inverse()
            shared = left(edge.shared if forth else edge.shared[:, ::-1], node, other)
            covered = is_candidate(node, other) and superseded_by(node, other, shared, between) is not None
            if covered and self._released(node.id, other.id):
                return other
        return None

    def _crowding(self, node: Node, now_ns: int) -> Node | None:
        """The nearest of the later views around a node, if there are many."""
        later = [
            (between.distance(Pose2()), other.id)
            for other in self._map.nodes.values()
            if now_ns - other.stamp_ns >= KEPT and other.stamp_ns - node.stamp_ns >= LATER * SECOND
            if in_basin(between := node.map_from_robot.mean.inverse() @ other.map_from_robot.mean)
        ]
        if len(later) < CROWD:
            return None
        here = within(node.id, WAY * FARTHEST, self._ways)
        nearest = sorted(view for view in later if view[1] in here)
        if len(nearest) < CROWD:
            return None
        return next((self._map.nodes[k] for _, k in nearest if self._released(node.id, k)), None)

    def _spare(self, node: Node, successor: Node) -> bool:
        """Whether the map holds together without a node, and no way becomes much longer."""
        own = self._ways(node.id)
        around = {other.id for _, other in self._edges(node.id)} - {successor.id}
        longer = node.map_from_robot.mean.distance(successor.map_from_robot.mean) + DETOUR
        limits = {other: own[other] + longer for other in around & own.keys()}
        tied = dict.fromkeys(around - own.keys(), float(len(self._map.nodes)))
        return reaches(successor.id, node.id, limits, self._ways) and reaches(
            successor.id, node.id, tied, self._ties
        )

    def _ways(self, node: NodeId) -> dict[NodeId, float]:
        """Own nodes to which an edge leads that can be driven, with the lengths, m."""
        ways: dict[NodeId, float] = {}
        for edge, other in self._edges(node):
            if edge.kind in RECOGNISED:
                a, b = (self._map.nodes[end] for end in (edge.a, edge.b))
                if not self._reaches.reach(edge, a, b, (None, None)).drivable:
                    continue
            length = edge.a_from_b.mean.distance(Pose2())
            ways[other.id] = min(length, ways.get(other.id, length))
        return ways

    def _ties(self, node: NodeId) -> dict[NodeId, float]:
        """Own nodes with an edge to a node, each one step away."""
        return {other.id: 1.0 for _, other in self._edges(node)}
