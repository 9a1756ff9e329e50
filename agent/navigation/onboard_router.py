"""Routes on the robot's own map, used when no map server answers."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import pairwise

import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Obstacle, RouteAnswer, RouteLeg
from mapweave.hybridmap.reachability import closed_edges
from mapweave.hybridmap.route import RouteTable
from mapweave.hybridmap.segments import distances


def onboard_route(
    own_map: HybridMap,
    start: NodeId,
    goal: NodeId,
    blocked: Collection[tuple[NodeId, NodeId]] = (),
    obstacles: Collection[Obstacle] = (),
) -> RouteAnswer:
    """Find the cheapest route between two nodes of the own map.

    Relative poses are those of the edges: nothing is optimised here, so a long route is as precise as its
    hops together.

    Args:
        own_map: of this robot.
        start: node by which the robot is localized.
        goal: the node to reach.
        blocked: pairs of nodes, in either order, between which the robot cannot drive.
        obstacles: places that it cannot pass; those at nodes of other maps are left out.
    """
    barred = {*blocked, *_past(own_map, obstacles)}
    route = RouteTable(own_map, blocked=barred, closed=closed_edges(own_map)).find(start, goal)
    if not route.nodes:
        return RouteAnswer((), f"own map: {route.reason}")
    origin = PoseGaussian(Pose2(), np.zeros((3, 3)))
    legs = [RouteLeg(own_map.nodes[start], origin, None)]
    for (before, node), edge in zip(pairwise(route.nodes), route.edges, strict=True):
        relative = own_map.edge_between(before, node)
        assert relative is not None, "the route runs along edges"
        legs.append(RouteLeg(own_map.nodes[node], relative, own_map.edges[edge].kind))
    return RouteAnswer(tuple(legs), f"own map: {route.reason}")


def _past(own_map: HybridMap, obstacles: Collection[Obstacle]) -> Iterator[tuple[NodeId, NodeId]]:
    """The pairs of nodes between which a robot would pass an obstacle."""
    poses = {node.id: node.map_from_robot.mean for node in own_map.nodes.values()}
    known = [one for one in obstacles if one.node in poses]
    pairs = [(e.a, e.b) for e in own_map.edges.values() if e.a in poses and e.b in poses]
    if not known or not pairs:
        return
    begin, end = (np.array([(poses[pair[k]].x, poses[pair[k]].y) for pair in pairs]) for k in (0, 1))
    centres = [poses[one.node] @ Pose2(one.x, one.y) for one in known]
    off = distances(np.array([(pose.x, pose.y) for pose in centres]), begin, end)
    near = off < np.array([one.reach for one in known])[:, None]
    yield from (pairs[k] for k in np.flatnonzero(near.any(axis=0)).tolist())
