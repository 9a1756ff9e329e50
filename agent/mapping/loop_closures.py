"""Loop closures: earlier places of the own map that a new node shows (paper, section 5)."""

from collections.abc import Callable

import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.registration.recognition import register

LOOP_REACH = 1.2
"""Nodes of the own map nearer than this are tried for a loop closure, m."""
LOOP_TURN = 0.7
"""Nodes turned by less than this are tried for a loop closure, rad."""
LOOP_TRIES = 4
"""Nodes that are tried for loop closures of a new node, nearest first."""
LOOP_SIGMA = 0.12
"""A loop closure known no better than this is left to the server, m."""
LOOP_GATE = 25.0
"""Chi-square with 3 degrees of freedom by which a loop closure may differ from the robot's own
measurement between the two nodes: places may look the same."""
LOOP_FLOOR = (0.05, 0.03)
"""Error of that measurement beyond its covariance, m and rad."""


class LoopClosures:
    """Recognises earlier nodes of one map in later ones."""

    def __init__(self, own_map: HybridMap, new_id: Callable[[], NodeId]) -> None:
        """Take the map, which grows, and what gives an edge its id."""
        self._map, self._new_id = own_map, new_id
        self._rng = np.random.default_rng(0)

    def edges(self, node: Node) -> list[Edge]:
        """The edges from each earlier place that a node shows."""
        found = [self.edge(earlier, node) for earlier in self.nearby(node, None)]
        return [edge for edge in found if edge is not None]

    def nearby(self, node: Node, before: NodeId | None) -> list[Node]:
        """Earlier places that a node may show, nearest first.

        Args:
            node: of the map, or to be in it soon.
            before: an earlier node to which it has an edge already.
        """
        nearby = []
        for candidate in self._map.nodes.values():
            between = candidate.map_from_robot.mean.inverse() @ node.map_from_robot.mean
            reach = float(np.hypot(between.x, between.y))
            earlier = candidate.id < node.id and candidate.id != before
            if earlier and reach < LOOP_REACH and abs(between.heading) < LOOP_TURN:
                nearby.append((reach, candidate))
        return [candidate for _, candidate in sorted(nearby, key=lambda pair: pair[0])[:LOOP_TRIES]]

    def edge(self, earlier: Node, node: Node) -> Edge | None:
        """The edge from an earlier place to a node that shows it; None if it does not."""
        recognition = register(earlier, node, None, self._rng)
        if recognition is None or recognition.evidence["sigma_xy"] >= LOOP_SIGMA:
            return None
        if not agrees_with_way(earlier, node, recognition.node_from_robot):
            return None
        pose, pairs, evidence = recognition.node_from_robot, recognition.pairs, recognition.evidence
        return Edge(self._new_id(), earlier.id, node.id, pose, EdgeKind.LOOP, pairs, evidence)


def agrees_with_way(earlier: Node, later: Node, measured: PoseGaussian) -> bool:
    """Whether a recognition agrees with the robot's own way from the earlier node to the later one.

    The later pose is the earlier one and the way, L = E W; so the way's covariance is
    W = L - Ad(w^-1) E Ad(w^-1)^T. Where the map was gone on with elsewhere in between, that is not so and
    the difference may have no meaning: what is negative of it counts as nothing.
    """
    way = earlier.map_from_robot.mean.inverse() @ later.map_from_robot.mean
    ad = way.inverse().adjoint
    grown = later.map_from_robot.covariance - ad @ earlier.map_from_robot.covariance @ ad.T
    values, vectors = np.linalg.eigh(0.5 * (grown + grown.T))
    grown = (vectors * np.maximum(values, 0.0)) @ vectors.T
    xy, heading = LOOP_FLOOR
    spread = grown + measured.covariance + np.diag([xy**2, xy**2, heading**2])
    return PoseGaussian(measured.mean, spread).mahalanobis2(way) < LOOP_GATE
