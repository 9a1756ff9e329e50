"""Driven edges of the map: measured on drives between two nodes, and more precise with every drive.

It is kept beside the other edges between the two nodes and replaces none of them: they were measured by
other means, and can be checked against each other (docs/decisions/driven-edges.md).
"""

from collections.abc import Callable

import numpy as np

from mapweave.agent.edge_measurement.traverse import Traverse
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian

THERE, BACK, INLIERS = "there", "back", "inliers"
"""Evidence: drives from a to b, drives from b to a, and most visible landmarks at a hand-over in between."""

AGREE = 16.27
"""Chi-square with 3 degrees of freedom, 99.9 %: drives that differ by more are between other places."""


def driven_edge(own_map: HybridMap, traverse: Traverse, new_id: Callable[[], EdgeId]) -> Edge:
    """The edge that a map holds after a traverse.

    Args:
        own_map: of the robot that drove. The nodes may be another's.
        traverse: as measured.
        new_id: returns an unused id of that map; called only for a new edge.

    Returns:
        The edge, from the smaller id to the greater: with the id of the earlier one, if these nodes were
        driven between before.
    """
    forth = traverse.start < traverse.end
    a, b = sorted((traverse.start, traverse.end))
    a_from_b = traverse.start_from_end if forth else traverse.start_from_end.inverse()
    evidence = {THERE: float(forth), BACK: float(not forth), INLIERS: float(traverse.landmarks)}
    earlier = _driven(own_map, traverse)
    if earlier is None:
        return Edge(new_id(), a, b, a_from_b, EdgeKind.DRIVEN, evidence=evidence)
    earlier_evidence = {name: earlier.evidence.get(name, 0.0) for name in evidence}
    drives = earlier_evidence[THERE] + earlier_evidence[BACK]
    if agree(earlier.a_from_b, a_from_b):
        a_from_b = averaged(earlier.a_from_b, drives, a_from_b)
        evidence = {name: value + earlier_evidence[name] for name, value in evidence.items()}
        evidence[INLIERS] = max(earlier_evidence[INLIERS], float(traverse.landmarks))
    elif drives > 1.0:
        # The majority counts (Boyer and Moore 1991): a contradicting drive cancels one that agreed.
        a_from_b, evidence = earlier.a_from_b, earlier_evidence
        evidence[THERE if earlier_evidence[THERE] >= earlier_evidence[BACK] else BACK] -= 1.0
    return Edge(earlier.id, a, b, a_from_b, EdgeKind.DRIVEN, evidence=evidence)


def averaged(earlier: PoseGaussian, drives: float, newest: PoseGaussian) -> PoseGaussian:
    """The average of a pose known from several drives and one known from one more.

    All drives see the same landmarks, so their errors are correlated. They are averaged by covariance
    intersection (Julier and Uhlmann 1997) with equal weights, which is consistent for any correlation: many
    drives are not more certain than the most certain of them.
    """
    share = 1.0 / (drives + 1.0)
    earlier_information, newest_information = (
        np.linalg.inv(earlier.covariance),
        np.linalg.inv(newest.covariance),
    )
    covariance = np.linalg.inv((1.0 - share) * earlier_information + share * newest_information)
    off = (earlier.mean.inverse() @ newest.mean).vector
    step = Pose2.from_vector(share * covariance @ newest_information @ off)
    return PoseGaussian(earlier.mean @ step, 0.5 * (covariance + covariance.T))


def agree(a: PoseGaussian, b: PoseGaussian) -> bool:
    """Whether two measurements may be of the same pose."""
    difference = PoseGaussian(a.mean, a.covariance + b.covariance)
    return difference.mahalanobis2(b.mean) < AGREE


def _driven(own_map: HybridMap, traverse: Traverse) -> Edge | None:
    """The edge of earlier drives between the same nodes."""
    between = own_map.edges_between(traverse.start, traverse.end)
    return next((edge for edge in between if edge.kind is EdgeKind.DRIVEN), None)
