"""Graduated non-convexity: which of the measurements that may be wrong are.

Truncated least squares counts no residual for more than its gate, so a wrong measurement costs the same
however wrong it is. That cost has many minima; so it is first replaced by a convex one, which is then bent
towards it step by step while the solution follows (Yang, Antonante, Tzoumas & Carlone, "Graduated
Non-Convexity for Robust Spatial Perception", RA-L 5(2), 2020; GTSAM's GncOptimizer). It needs no guess of
which are wrong to begin with, and is no proof either: with many more wrong measurements than right ones it
may end in another minimum.
"""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from hybridmap.node import NodeId
from hybridmap.pose import Pose2
from merge.graph.posegraph import Measurement, Problem

SURE = 0.5
"""Weight from which a measurement counts as right; at the end nearly all weights are 0 or 1."""


def wrong_measurements(
    anchor: NodeId, anchor_pose: Pose2, measurements: Iterable[Measurement], gate: float
) -> list[Measurement]:
    """Find the robust measurements of one connected component that are wrong.

    Args:
        anchor: the node that is held.
        anchor_pose: where.
        measurements: those that are not robust are believed.
        gate: chi-square with 3 degrees of freedom above which a measurement is wrong.

    Returns:
        The wrong ones, in the order of their nodes; they depend on the set of measurements, not on its order.
    """
    # GNC sets the weights itself: its factors must have plain noise.
    problem = Problem.of(anchor, anchor_pose, measurements, huber=np.inf)
    believed = [0] + [k for k, m in enumerate(problem.measurements, 1) if not m.robust]
    if len(believed) == 1 + len(problem.measurements):
        return []
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(believed)
    optimizer = gtsam.GncLMOptimizer(problem.graph, problem.values, parameters)
    # A factor's cost is half its squared residual.
    optimizer.setInlierCostThresholds(0.5 * gate)
    optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())[1:]
    return [m for m, weight in zip(problem.measurements, weights, strict=True) if weight < SURE]
