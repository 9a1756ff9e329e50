"""Where the nodes of a map lie as seen from one of them, and how far away they are, over its edges."""

import heapq
import math

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian

LEVER = 3.0
"""An error of heading counts by what it moves so far away, m."""


def relative_poses(own_map: HybridMap, start: NodeId) -> dict[NodeId, Pose2]:
    """Poses of the nodes that edges reach from a node, `start_from_node`.

    Loop closures take part at once, without a pose graph: what is near over them lies where they say. Around
    a loop the error that is left lies where two ways are equally certain, far from the start (Sibley, Mei,
    Reid, Newman: Adaptive relative bundle adjustment, RSS 2009).
    """
    poses: dict[NodeId, Pose2] = {}
    queue: list[tuple[float, NodeId, NodeId]] = [(0.0, start, start)]
    while queue:
        variance, node, before = heapq.heappop(queue)
        if node in poses:
            continue
        last = None if node == before else own_map.edge_between(before, node)
        poses[node] = Pose2() if last is None else poses[before] @ last.mean
        for other in own_map.neighbours(node):
            edge = own_map.edge_between(node, other)
            if edge is not None and other in own_map.nodes and other not in poses:
                heapq.heappush(queue, (variance + _variance(edge), other, node))
    return poses


def way_lengths(own_map: HybridMap, start: NodeId) -> dict[NodeId, float]:
    """Lengths of the shortest ways over edges from a node to those that they reach, m."""
    lengths: dict[NodeId, float] = {}
    queue: list[tuple[float, NodeId]] = [(0.0, start)]
    while queue:
        length, node = heapq.heappop(queue)
        if node in lengths:
            continue
        lengths[node] = length
        for other in own_map.neighbours(node):
            edge = own_map.edge_between(node, other)
            if edge is not None and other in own_map.nodes and other not in lengths:
                heapq.heappush(queue, (length + math.hypot(edge.mean.x, edge.mean.y), other))
    return lengths


def _variance(edge: PoseGaussian) -> float:
    """m^2."""
    c = edge.covariance
    return float(c[0, 0] + c[1, 1] + LEVER**2 * c[2, 2])
