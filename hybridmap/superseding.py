"""When a node supersedes another: the rule, for the merged map of a fleet and for a robot's own map.

A node is superseded if a robot at its pose would recognise another node and could servo to it, and if no way
between its neighbours becomes much longer without it (docs/decisions/life-of-a-map.md has the figures).
"""

import heapq
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.reachability import FARTHEST, STOPS, WIDEST, least_in_view
from mapweave.hybridmap.superseded import Superseded

FOUND = 20
"""Landmarks that both show and that stay in view between them."""
DEPTHS = 0.7
"""A successor has at least this share of the superseded node's number of depths,"""
ENOUGH = 60
"""or at least this many."""
AGAIN = 120.0
"""Nodes of one map supersede each other only if this much time is between them, s: views of one visit
complete each other."""
DETOUR = 1.5
"""A way between neighbours may become longer by this, m."""
SECOND = 1_000_000_000
LATER = 14 * 86_400.0
"""s after which a view is of another time,"""
CROWD = 6
"""and so many of it within the basin of a node supersede it, whatever they show: what none of them recognises
is seen from next to there alone, or is gone. So there are no more nodes than there is room."""
WAY = 1.5
"""They are no further off by the way than so many times the basin's reach: no wall is between."""

Ways = Callable[[NodeId], Mapping[NodeId, float]]
"""Gives the neighbours of a node to which a robot could drive, with the lengths of the ways, m."""


def same_visit(a: Node, b: Node) -> bool:
    """Whether two nodes were made on one visit of their place."""
    return a.id.map == b.id.map and abs(a.stamp_ns - b.stamp_ns) < AGAIN * SECOND


def is_candidate(node: Node, successor: Node) -> bool:
    """Whether a node may supersede another by what each has by itself."""
    depths = successor.landmarks.has_depth.sum()
    least = min(DEPTHS * node.landmarks.has_depth.sum(), ENOUGH)
    return bool(depths >= least) and not same_visit(node, successor)


def in_basin(node_from_other: Pose2) -> bool:
    """Whether the servo could drive from one pose to the other, if it sees enough."""
    return node_from_other.distance(Pose2()) <= FARTHEST and abs(node_from_other.heading) <= WIDEST


def superseded_by(
    node: Node, successor: Node, shared: NDArray[np.int64], node_from_successor: Pose2
) -> Superseded | None:
    """Why a candidate supersedes a node; None if it does not.

    Args:
        node: that may be superseded.
        successor: a candidate.
        shared: (K, 2) landmarks of the node and of the successor that are the same.
        node_from_successor: relative pose.
    """
    if not in_basin(node_from_successor):
        return None
    distance, turn = node_from_successor.distance(Pose2()), abs(node_from_successor.heading)
    in_view = least_in_view(shared, node, successor, node_from_successor, STOPS)
    return Superseded(successor.id, in_view, distance, turn) if in_view >= FOUND else None


def reaches(start: NodeId, without: NodeId, limits: Mapping[NodeId, float], ways: Ways) -> bool:
    """Whether all nodes are reached within their limits; by Dijkstra's algorithm.

    Args:
        start: where the ways begin.
        without: a node over which none leads.
        limits: by node, m.
        ways: of the nodes that are left.
    """
    left, farthest = dict(limits), max(limits.values(), default=0.0)
    settled: set[NodeId] = set()
    heap = [(0.0, start)]
    while heap and left:
        length, node = heapq.heappop(heap)
        if node in settled:
            continue
        settled.add(node)
        if left.pop(node, length) < length:
            return False
        for neighbour, step in ways(node).items():
            if neighbour != without and neighbour not in settled and length + step <= farthest:
                heapq.heappush(heap, (length + step, neighbour))
    return not left


def within(start: NodeId, reach: float, ways: Ways) -> set[NodeId]:
    """Other nodes that are reached by ways of some length at most, m."""
    lengths, heap = {start: 0.0}, [(0.0, start)]
    while heap:
        length, here = heapq.heappop(heap)
        if length > lengths[here]:
            continue
        for neighbour, step in ways(here).items():
            farther = length + step
            if farther < min(lengths.get(neighbour, reach), reach):
                lengths[neighbour] = farther
                heapq.heappush(heap, (farther, neighbour))
    return {*lengths} - {start}
