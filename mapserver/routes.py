"""Routes through the merged map."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import EdgeId, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.query import RouteAnswer, RouteLeg
from hybridmap.route import RouteSettings, find_route
from merge.merged import MergedMap


class Router:
    """Answers how to get from node to node. It stands for one merged map; make another for the next."""

    def __init__(self, merged: MergedMap, settings: RouteSettings | None = None) -> None:
        """Take a merged map."""
        self._union: HybridMap = merged.union()
        self._postures = {node: place.merged_from_robot.mean for node, place in merged.postures.items()}
        self._merged = merged
        self._settings = settings

    def route(
        self,
        start: NodeId,
        goal: NodeId,
        blocked: Collection[tuple[NodeId, NodeId]] = (),
        penalties: Mapping[EdgeId, float] | None = None,
    ) -> RouteAnswer:
        """Find the cheapest way.

        Args:
            start: where the robot is.
            goal: where it shall be.
            blocked: pairs of nodes, in either order, between which the robot cannot drive.
            penalties: extra cost of edges, m.

        Returns:
            The legs, each with the edge's own measured relative posture: it was measured where the robot
            will drive, while merged postures spread every edge's error over the whole map.
        """
        for name, node in (("start", start), ("goal", goal)):
            if node not in self._postures:
                return RouteAnswer((), f"{name} {node} is not in the merged map")
        if self._merged.component_of(start) != self._merged.component_of(goal):
            return RouteAnswer((), f"{start} and {goal} are in parts of the map that nothing joins yet")
        found = find_route(
            self._union,
            start,
            goal,
            postures=self._postures,
            penalties=penalties,
            blocked=blocked,
            settings=self._settings,
        )
        if not found.nodes:
            return RouteAnswer((), found.reason)
        legs = [RouteLeg(self._union.nodes[start], PoseGaussian(Pose2(), np.zeros((3, 3))), None)]
        for node, edge_id in zip(found.nodes[1:], found.edges, strict=True):
            edge = self._union.edges[edge_id]
            relative = edge.a_from_b if edge.b == node else edge.a_from_b.inverse()
            legs.append(RouteLeg(self._union.nodes[node], relative, edge.kind))
        return RouteAnswer(tuple(legs), found.reason)
