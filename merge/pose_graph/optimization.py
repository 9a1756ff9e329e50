"""Poses that agree best with what was measured between them: GTSAM, from where they were."""

from typing import Any

import numpy as np

from mapweave.hybridmap.pose import Array
from mapweave.merge.pose_graph.factors import Factors, Rows

ANCHOR_SIGMA = 1e-5
"""What is held, is held as well as this, m and rad."""
TOLERANCE = 1e-9
"""The solver stops when a step makes the cost smaller by less than this, absolutely or as a share of it."""


def optimized(factors: Factors, means: Array, free: Rows, held: Rows) -> Array:
    """Levenberg-Marquardt on some nodes; all others stay where they are.

    Args:
        factors: measurements between N nodes.
        means: (N, 3) m, m, rad, where they are.
        free: rows of nodes that move.
        held: those of them that do not.

    Returns:
        (N, 3) where they are then.
    """
    import gtsam

    inside = np.zeros(len(means), np.bool_)
    inside[free] = True
    inside[held] = False
    index = np.flatnonzero(inside[factors.a] | inside[factors.b])
    if not len(index):
        return means
    part = factors.take(index)
    rows = np.unique(np.concatenate([part.a, part.b]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tight = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_SIGMA)
    for row, pose in zip(rows.tolist(), means[rows].tolist(), strict=True):
        values.insert(row, gtsam.Pose2(*pose))
        if not inside[row]:
            graph.add(gtsam.PriorFactorPose2(row, gtsam.Pose2(*pose), tight))
    add_measurements(graph, part)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(TOLERANCE)
    parameters.setAbsoluteErrorTol(TOLERANCE)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    moved = rows[inside[rows]]
    out = means.copy()
    # In the order of the keys, which are the rows.
    out[moved] = gtsam.utilities.extractPose2(solution)[inside[rows]]
    return out


def add_measurements(graph: Any, part: Factors) -> None:
    """Put measurements into a GTSAM graph; its keys are their rows."""
    # W = R' R
    import gtsam

    roots = np.linalg.cholesky(part.weights).transpose(0, 2, 1)
    for a, b, mean, root in zip(part.a.tolist(), part.b.tolist(), part.means.tolist(), roots, strict=True):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
        graph.add(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*mean), noise))
