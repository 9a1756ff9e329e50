"""Routes through the merged map."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Edge, EdgeId, EdgeKind, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.query import RouteAnswer, RouteLeg
from hybridmap.route import Route, RouteSettings, find_route
from merge.merged import MergedMap

ENTRIES = 12
"""Nodes that are tried as the beginning of a route."""
UNDRIVEN = (EdgeKind.LOOP, EdgeKind.MERGED)
"""Edges that were recognised, but that nobody may have driven."""


@dataclass(frozen=True)
class RouterSettings:
    """How routes are chosen.

    Attributes:
        route: what a way costs.
        near: nodes nearer than this to each other count as joined, whatever they show, m: less than what two
            robots keep apart on the two sides of a wall.
        entry_reach: a robot may enter the map at nodes nearer than this, m.
        entry_cost: what a metre from the robot to its first node costs: nobody has driven it yet.
        on_edge: a robot this near to an edge that was driven stands on it, m: along it a metre costs a metre,
            so that it need not turn back to the edge's beginning.
        wary_cost: what it costs to try again where another robot did not get through, m.
    """

    route: RouteSettings = field(default_factory=RouteSettings)
    near: float = 0.5
    entry_reach: float = 1.5
    entry_cost: float = 3.0
    on_edge: float = 0.25
    wary_cost: float = 4.0


class Router:
    """Answers how to get from node to node. It stands for one merged map; make another for the next."""

    def __init__(self, merged: MergedMap, settings: RouterSettings | None = None) -> None:
        """Take a merged map."""
        self._union: HybridMap = merged.union()
        self._postures = {node: place.merged_from_robot.mean for node, place in merged.postures.items()}
        self._merged = merged
        self._settings = settings or RouterSettings()
        self._join_near()

    def _join_near(self) -> None:
        """Let routes change between nodes that stand in one place and look in different directions."""
        for number, members in enumerate(self._merged.components):
            nodes = sorted(members)
            places = np.array([[self._postures[n].x, self._postures[n].y] for n in nodes])
            for k, (i, j) in enumerate(sorted(cKDTree(places).query_pairs(self._settings.near))):
                a, b = nodes[i], nodes[j]
                if not self._union.graph.has_edge(a, b):
                    between = PoseGaussian(self._postures[a].inverse() @ self._postures[b], np.zeros((3, 3)))
                    edge = Edge(EdgeId("near", number, k), a, b, between, EdgeKind.LOOP)
                    self._union.edges[edge.id] = edge

    def route(
        self,
        start: NodeId,
        goal: NodeId,
        blocked: Collection[tuple[NodeId, NodeId]] = (),
        wary: Collection[tuple[NodeId, NodeId]] = (),
        start_from_robot: Pose2 | None = None,
    ) -> RouteAnswer:
        """Find the cheapest way.

        Args:
            start: a node that the robot knows itself by.
            goal: where it shall be.
            blocked: pairs of nodes, in either order, between which the robot cannot drive.
            wary: pairs of nodes, in either order, between which another robot did not get through: they are
                driven only where every other way is much longer.
            start_from_robot: where the robot is. It may see the start node from afar, then the route begins
                at a node that is nearer and better placed; None if it stands at the start node.

        Returns:
            The legs. Their relative postures are those of the optimised graph: each is the best estimate
            from all edges together. That of the first is relative to `start`.
        """
        for name, node in (("start", start), ("goal", goal)):
            if node not in self._postures:
                return RouteAnswer((), f"{name} {node} is not in the merged map")
        if self._merged.component_of(start) != self._merged.component_of(goal):
            return RouteAnswer((), f"{start} and {goal} are in parts of the map that nothing joins yet")
        penalties = self._penalties(wary)
        best: Route | None = None
        reason, best_cost = "", math.inf
        for entry, cost in self._entries(start, start_from_robot, blocked):
            if cost >= best_cost:
                break
            found = find_route(
                self._union, entry, goal, postures=self._postures, penalties=penalties, blocked=blocked,
                settings=self._settings.route,
            )  # fmt: skip
            reason = reason or found.reason
            if found.nodes and cost + found.cost < best_cost:
                best, best_cost = found, cost + found.cost
        if best is None:
            return RouteAnswer((), reason or f"every way into the map near {start} is blocked")
        legs = [RouteLeg(self._union.nodes[best.nodes[0]], self._relative(start, best.nodes[0]), None)]
        for before, node, edge_id in zip(best.nodes, best.nodes[1:], best.edges, strict=False):
            edge = self._union.edges[edge_id]
            legs.append(RouteLeg(self._union.nodes[node], self._relative(before, node), edge.kind))
        return RouteAnswer(tuple(legs), best.reason)

    def _entries(
        self, start: NodeId, start_from_robot: Pose2 | None, blocked: Collection[tuple[NodeId, NodeId]]
    ) -> list[tuple[NodeId, float]]:
        """Nodes where the route may begin with what it costs to get there, cheapest first."""
        if start_from_robot is None:
            return [(start, 0.0)]
        s = self._settings
        here = self._postures[start] @ start_from_robot
        component = self._merged.component_of(start)
        barred = {frozenset(pair) for pair in blocked}
        near = sorted((here.distance(self._postures[n]), n) for n in self._merged.components[component or 0])
        entries = [
            (node, s.entry_cost * distance - self._saved(here, node, distance, barred))
            for distance, node in near
            if (distance <= s.entry_reach or node == start) and frozenset((start, node)) not in barred
        ]
        return sorted(entries, key=lambda entry: entry[1])[:ENTRIES]

    def _saved(self, here: Pose2, node: NodeId, distance: float, barred: set[frozenset[NodeId]]) -> float:
        """By how much it is cheaper to get to a node for a robot that stands on an edge to it, m."""
        s = self._settings
        target = self._postures[node]
        goal = np.array([target.x, target.y])
        at = np.array([here.x, here.y])
        saved = 0.0
        for _, other, edge_id in self._union.graph.edges(node, keys=True):
            if self._union.edges[edge_id].kind in UNDRIVEN or frozenset((node, other)) in barred:
                continue
            if other not in self._postures:
                continue
            along = np.array([self._postures[other].x, self._postures[other].y]) - goal
            share = float(np.clip((at - goal) @ along / max(along @ along, 1e-9), 0.0, 1.0))
            off = float(np.linalg.norm(at - goal - share * along))
            if off <= s.on_edge and share < 1.0:
                saved = max(saved, (s.entry_cost - 1.0) * (distance - off))
        return saved

    def _penalties(self, wary: Collection[tuple[NodeId, NodeId]]) -> Mapping[EdgeId, float]:
        if not wary:
            return {}
        pairs, cost = {frozenset(pair) for pair in wary}, self._settings.wary_cost
        return {edge.id: cost for edge in self._union.edges.values() if frozenset((edge.a, edge.b)) in pairs}

    def _relative(self, a: NodeId, b: NodeId) -> PoseGaussian:
        if a == b:
            return PoseGaussian(Pose2(), np.zeros((3, 3)))
        relative = self._merged.relative(a, b)
        assert relative is not None, "nodes of one component"
        return relative
