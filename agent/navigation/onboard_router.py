"""Routes on the robot's own map, used when no map server answers."""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise

import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import RouteAnswer, RouteLeg
from mapweave.hybridmap.reachability import closed_edges
from mapweave.hybridmap.route import find_route


def onboard_route(
    own_map: HybridMap,
    start: NodeId,
    goal: NodeId,
    blocked: Collection[tuple[NodeId, NodeId]] = (),
) -> RouteAnswer:
    """Find the cheapest route between two nodes of the own map.

    Relative poses are those of the edges: nothing is optimised here, so a long route is as precise as its
    hops together.

    Args:
        own_map: of this robot.
        start: node by which the robot is localized.
        goal: the node to reach.
        blocked: pairs of nodes, in either order, between which the robot cannot drive.
    """
    route = find_route(own_map, start, goal, blocked=blocked, closed=closed_edges(own_map))
    if not route.nodes:
        return RouteAnswer((), f"own map: {route.reason}")
    origin = PoseGaussian(Pose2(), np.zeros((3, 3)))
    legs = [RouteLeg(own_map.nodes[start], origin, None)]
    for (before, node), edge in zip(pairwise(route.nodes), route.edges, strict=True):
        relative = own_map.edge_between(before, node)
        assert relative is not None, "the route runs along edges"
        legs.append(RouteLeg(own_map.nodes[node], relative, own_map.edges[edge].kind))
    return RouteAnswer(tuple(legs), f"own map: {route.reason}")
