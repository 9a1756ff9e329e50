"""What routes may use of a merged map: edges that can be driven, and active nodes."""

from collections.abc import Collection, Iterator, Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.area import Floats
from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.reachability import RECOGNISED
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.merge.pose_graph.merged_map import MergedMap

NEAR, SUCCESSION = IMPLIED = ("near", "superseded")
"""Take the agents' place in the ids of edges that follow from the nodes' poses."""
Faded = Mapping[NodeId, NDArray[np.bool_]]
"""Of each node which landmarks have faded."""


class ClosedEdges(Collection[EdgeId]):
    """Edges of a map that the servo could not drive; each is evaluated on demand."""

    def __init__(
        self, union: HybridMap, faded: Faded, cache: ReachabilityCache, out_of_sight: bool = False
    ) -> None:
        """Take a map.

        Args:
            union: nodes and edges.
            faded: faded landmarks.
            cache: of reachability.
            out_of_sight: only those on which the robot loses sight of the landmarks.
        """
        self._union, self._faded, self._cache = union, faded, cache
        self._out_of_sight = out_of_sight

    def __contains__(self, edge_id: object) -> bool:
        """Whether the servo could not drive an edge of the map."""
        edge = self._union.edges.get(edge_id) if isinstance(edge_id, NodeId) else None
        if edge is None or edge.kind not in RECOGNISED or edge.id.agent in IMPLIED:
            return False
        nodes = self._union.nodes
        if edge.a not in nodes or edge.b not in nodes:
            return False
        faded = self._faded.get(edge.a), self._faded.get(edge.b)
        reach = self._cache.reach(edge, nodes[edge.a], nodes[edge.b], faded)
        return not (reach.in_sight if self._out_of_sight else reach.drivable)

    def __iter__(self) -> Iterator[EdgeId]:
        """All of them: evaluates every edge."""
        return (edge_id for edge_id in self._union.edges if edge_id in self)

    def __len__(self) -> int:
        """How many: evaluates every edge."""
        return sum(1 for _ in self)


class Roadmap:
    """The edges of a merged map, and those that follow from where nodes are.

    Attributes:
        merged: the map.
        union: its nodes and edges. In addition, nodes at one place are joined, whatever they show: a robot
            can turn there. And every superseded node is joined with its successor.
        closed: edges that only tie poses.
        out_of_sight: those of them on which a robot does not see all the way where it is.
        poses: of all nodes.
        active_poses: of the active nodes.
    """

    def __init__(self, merged: MergedMap, same_place: float, reaches: ReachabilityCache) -> None:
        """Take a merged map.

        Args:
            merged: the map.
            same_place: nodes nearer than this to each other are at one place, m.
            reaches: cache of reachability.
        """
        self.merged = merged
        self.union: HybridMap = merged.union()
        self.closed, self.out_of_sight = (
            ClosedEdges(self.union, merged.faded, reaches, out_of_sight) for out_of_sight in (False, True)
        )
        reaches.forget(self.union.edges)
        self.poses = {node: merged.pose(node) for node in merged.poses}
        self.active_poses = {node: p for node, p in self.poses.items() if node not in merged.superseded}
        self._segments: dict[int, tuple[list[tuple[NodeId, NodeId]], Floats, Floats]] = {}
        self._join_nearby(same_place)
        for k, (node, fate) in enumerate(sorted(merged.superseded.items())):
            if node in self.poses and fate.by in self.poses:
                self._join(EdgeId(SUCCESSION, 0, k), node, fate.by)

    @cached_property
    def radii(self) -> dict[str, float]:
        """The largest radius that a robot's own nodes give it, m, by the robot's name."""
        radii: dict[str, float] = {}
        for node_id, node in self.union.nodes.items():
            radii[node_id.agent] = max(radii.get(node_id.agent, 0.0), node.radius)
        return radii

    def segments(self, component: int) -> tuple[list[tuple[NodeId, NodeId]], Floats, Floats]:
        """Joined pairs of nodes of a component, and (N, 2) where each begins and ends in the merged frame."""
        if component not in self._segments:
            members = self.merged.components[component]
            joined = {(a, b) for a in members for b in self.union.neighbours(a) if a <= b and b in members}
            pairs = [pair for pair in sorted(joined) if pair[0] in self.poses and pair[1] in self.poses]
            ends = [
                np.array([(self.poses[pair[k]].x, self.poses[pair[k]].y) for pair in pairs]).reshape(-1, 2)
                for k in (0, 1)
            ]
            self._segments[component] = pairs, ends[0], ends[1]
        return self._segments[component]

    def _join_nearby(self, same_place: float) -> None:
        from scipy.spatial import cKDTree

        for number, members in enumerate(self.merged.components):
            nodes = sorted(node for node in members if node in self.poses)
            if not nodes:
                continue
            places = np.array([[self.poses[n].x, self.poses[n].y] for n in nodes])
            for k, (i, j) in enumerate(sorted(cKDTree(places).query_pairs(same_place))):
                if not self._drivable_between(nodes[i], nodes[j]):
                    self._join(EdgeId(NEAR, number, k), nodes[i], nodes[j])

    def _drivable_between(self, a: NodeId, b: NodeId) -> bool:
        return any(edge.id not in self.closed for edge in self.union.edges_between(a, b))

    def _join(self, edge_id: EdgeId, a: NodeId, b: NodeId) -> None:
        between: Pose2 = self.poses[a].inverse() @ self.poses[b]
        edge = Edge(edge_id, a, b, PoseGaussian(between, np.zeros((3, 3))), EdgeKind.LOOP)
        self.union.apply(EdgePut(edge))
