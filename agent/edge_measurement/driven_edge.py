"""What was driven is written into the map: an edge between two nodes, known better with every drive.

It stands beside what else the map says of its two nodes, and never in its place: that was measured by other
means, and only where both are there can the one refute the other (docs/decisions/driven-edges.md).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mapweave.agent.edge_measurement.traverse import Traverse
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import Edge, EdgeId, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian

THERE, BACK, INLIERS = "there", "back", "inliers"
"""Evidence: drives from a to b, drives from b to a, and most landmarks in sight at a hand-over in between."""

AGREE = 16.27
"""Chi-square with 3 degrees of freedom, 99.9 %: drives that differ by more are not of the same two places."""


def driven_edge(own_map: HybridMap, traverse: Traverse, new_id: Callable[[], EdgeId]) -> Edge:
    """The edge that a map holds after a traverse.

    Args:
        own_map: of the robot that drove. The nodes may be another's.
        traverse: as measured.
        new_id: draws an id of that map; asked only for an edge that is new.

    Returns:
        The edge, from the smaller id to the greater: with the id of the earlier one, if these nodes were
        driven between before. It is to be put.
    """
    forth = traverse.start < traverse.end
    a, b = sorted((traverse.start, traverse.end))
    a_from_b = traverse.start_from_end if forth else traverse.start_from_end.inverse()
    evidence = {THERE: float(forth), BACK: float(not forth), INLIERS: float(traverse.landmarks)}
    earlier = _driven(own_map, traverse)
    if earlier is None:
        return Edge(new_id(), a, b, a_from_b, EdgeKind.DRIVEN, evidence=evidence)
    known = {name: earlier.evidence.get(name, 0.0) for name in evidence}
    drives = known[THERE] + known[BACK]
    if agree(earlier.a_from_b, a_from_b):
        a_from_b = averaged(earlier.a_from_b, drives, a_from_b)
        evidence = {name: value + known[name] for name, value in evidence.items()}
        evidence[INLIERS] = max(known[INLIERS], float(traverse.landmarks))
    elif drives > 1.0:
        # The majority counts (Boyer and Moore 1991): a drive that contradicts takes one that agreed away.
        a_from_b, evidence = earlier.a_from_b, known
        evidence[THERE if known[THERE] >= known[BACK] else BACK] -= 1.0
    return Edge(earlier.id, a, b, a_from_b, EdgeKind.DRIVEN, evidence=evidence)


def averaged(earlier: PoseGaussian, drives: float, newest: PoseGaussian) -> PoseGaussian:
    """The average of a pose known from several drives and one known from one more.

    All drives see by the same landmarks, and err alike by these. So they are averaged by covariance
    intersection (Julier and Uhlmann 1997) with equal weights, which holds however they are correlated: many
    drives are not surer than the surest of them.
    """
    share = 1.0 / (drives + 1.0)
    known, new = np.linalg.inv(earlier.covariance), np.linalg.inv(newest.covariance)
    covariance = np.linalg.inv((1.0 - share) * known + share * new)
    off = (earlier.mean.inverse() @ newest.mean).vector
    step = Pose2.from_vector(share * covariance @ new @ off)
    return PoseGaussian(earlier.mean @ step, 0.5 * (covariance + covariance.T))


def agree(one: PoseGaussian, other: PoseGaussian) -> bool:
    """Whether two measurements may be of the same pose."""
    both = PoseGaussian(one.mean, one.covariance + other.covariance)
    return both.mahalanobis2(other.mean) < AGREE


def _driven(own_map: HybridMap, traverse: Traverse) -> Edge | None:
    """The edge of earlier drives between the same nodes."""
    between = own_map.graph.get_edge_data(traverse.start, traverse.end) or ()
    return next((e for e in map(own_map.edges.__getitem__, between) if e.kind is EdgeKind.DRIVEN), None)
