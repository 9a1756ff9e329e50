"""Passages: what can be driven between the nodes of a merged map, and whether a node can be spared."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.reachability import RECOGNISED
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.hybridmap.superseding import reaches, within
from mapweave.merge.map_maintenance.adjacency import Adjacency
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.registration.pose_arrays import compose_poses, inverse_poses

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


class Traversability:
    """Edges that can be driven, and nodes at one place, among the active nodes.

    Nothing is worked out but around the nodes that are asked about.
    """

    def __init__(
        self,
        merged: MergedMap,
        links: Adjacency,
        reaches: ReachabilityCache,
        same_place: float,
        foreign: Iterable[Edge] = (),
        without: Iterable[NodeId] = (),
        unsure: Container[MapId] = (),
    ) -> None:
        """Take a merged map.

        Args:
            merged: the map.
            links: of it.
            reaches: cache of reachability; it is filled.
            same_place: m, nodes nearer than this to each other are at one place.
            foreign: edges that lead out of their own maps, see `ForeignEdges`.
            without: nodes that are left out from the start.
            unsure: maps that may not be right: no other robot's node is spared for ways over their nodes.
        """
        self._merged, self._reachability, self._same_place = merged, reaches, same_place
        self._removed, self._unsure = set(without), unsure
        self._trees: dict[NodeId, cKDTree] = {}
        self._ways: dict[NodeId, dict[NodeId, float]] = {}
        self._foreign: dict[NodeId, list[Edge]] = {}
        for edge in foreign:
            for end in (edge.a, edge.b):
                self._foreign.setdefault(end, []).append(edge)
        self._links = links
        self._false = {refusal.edge for refusal in merged.refused if refusal.edge is not None}

    def has(self, node: NodeId) -> bool:
        """Whether a node is left."""
        return node not in self._removed

    def remove(self, node: NodeId) -> None:
        """Leave a node out from now on."""
        self._removed.add(node)

    def add(self, node: NodeId) -> None:
        """Take a node in again."""
        self._removed.discard(node)

    def around(self, node: NodeId, reach: float, with_removed: bool = False) -> list[NodeId]:
        """Other nodes that are left, of the same component, within a distance, m; in the order of ids.

        Args:
            node: in the middle.
            reach: m.
            with_removed: those that were left out too.
        """
        from scipy.spatial import cKDTree

        graph = self._graph(node)
        if graph.anchor not in self._trees:
            self._trees[graph.anchor] = cKDTree(graph.means[:, :2])
        rows = self._trees[graph.anchor].query_ball_point(graph.means[graph.rows[node], :2], reach)
        nodes = (graph.nodes[k] for k in rows)
        return sorted(
            neighbour
            for neighbour in nodes
            if neighbour != node and (with_removed or neighbour not in self._removed)
        )

    def stances(self, node: NodeId, others: Sequence[NodeId]) -> Array:
        """(K, 3) m, m, rad, relative poses of other nodes of the same component."""
        graph = self._graph(node)
        poses, other_poses = (graph.means[graph.index(some)] for some in ([node], others))
        return compose_poses(inverse_poses(poses), other_poses)

    def spare(self, node: NodeId, successor: NodeId, detour: float) -> bool:
        """Whether every neighbour of a node is reached from its successor without the node.

        Args:
            node: that may be left out.
            successor: that supersedes it.
            detour: m, by which such a way may be longer than over the node.
        """
        own = self._ways_of(node)
        to_successor = self._distance(node, successor)
        limits = {
            neighbour: length + to_successor + detour
            for neighbour, length in own.items()
            if neighbour != successor and self._counts(neighbour, node)
        }
        return not limits or reaches(successor, node, limits, partial(self._open_ways, node))

    def within(self, node: NodeId, reach: float) -> set[NodeId]:
        """Nodes that are left and that are reached from a node by ways of some length at most, m."""
        return within(node, reach, partial(self._open_ways, node))

    def _open_ways(self, asked: NodeId, node: NodeId) -> dict[NodeId, float]:
        """Neighbours that count for the node that is asked about, with the distance, m."""
        ways = self._ways_of(node).items()
        if not self._unsure:
            # Asked for at each node of each way.
            return {neighbour: step for neighbour, step in ways if neighbour not in self._removed}
        return {neighbour: step for neighbour, step in ways if self._counts(neighbour, asked)}

    def _counts(self, node: NodeId, asked: NodeId) -> bool:
        """Whether a node is left, and is sure or of the robot whose node is asked about."""
        return node not in self._removed and (node.agent == asked.agent or node.map not in self._unsure)

    def _ways_of(self, node: NodeId) -> dict[NodeId, float]:
        """Neighbours, also those that were left out, with the distance, m."""
        if node not in self._ways:
            neighbours = {neighbour for edge in self._edges(node) for neighbour in (edge.a, edge.b)}
            graph = self._graph(node)
            neighbours |= set(self.around(node, self._same_place))
            neighbours = {neighbour for neighbour in neighbours if neighbour in graph.rows}
            self._ways[node] = {
                neighbour: self._distance(node, neighbour) for neighbour in neighbours - {node}
            }
        return self._ways[node]

    def _edges(self, node: NodeId) -> Iterator[Edge]:
        own = self._merged.maps[node.map].edges_at(node)
        links = (link.edge() for link in self._links.at(node))
        for edge in (*own, *links, *self._foreign.get(node, ())):
            if edge.id not in self._false and self._drivable(edge):
                yield edge

    def _drivable(self, edge: Edge) -> bool:
        if edge.kind not in RECOGNISED:
            return True
        maps = self._merged.maps
        a, b = (maps[end.map].nodes.get(end) if end.map in maps else None for end in (edge.a, edge.b))
        return a is not None and b is not None and self._reachability.reach(edge, a, b, (None, None)).drivable

    def _graph(self, node: NodeId) -> PoseGraph:
        component = self._merged.component_of(node)
        assert component is not None, "a node of the merged map"
        return self._merged.graphs[component]

    def _distance(self, a: NodeId, b: NodeId) -> float:
        graph = self._graph(a)
        off = graph.means[graph.rows[a], :2] - graph.means[graph.rows[b], :2]
        return float(np.hypot(off[0], off[1]))


class ForeignEdges:
    """Edges that lead out of their own maps: drives among others' nodes. A map is read once."""

    def __init__(self) -> None:
        self._cache: dict[MapId, tuple[HybridMap, tuple[Edge, ...]]] = {}

    def of(self, maps: Mapping[MapId, HybridMap]) -> list[Edge]:
        """Those of all maps, in the order of the maps."""
        before, self._cache = self._cache, {}
        for map_id, hybrid_map in maps.items():
            entry = before.get(map_id)
            if entry is None or entry[0] is not hybrid_map:
                out = (edge for edge in hybrid_map.edges.values() if {edge.a.map, edge.b.map} != {map_id})
                entry = hybrid_map, tuple(out)
            self._cache[map_id] = entry
        return [edge for map_id in sorted(self._cache) for edge in self._cache[map_id][1]]
