"""Graduated non-convexity: which of the measurements that may be wrong are.

Truncated least squares counts no residual for more than its gate, so a wrong measurement costs the same
however wrong it is. That cost has many minima; so it is first replaced by a convex one, which is then bent
towards it step by step while the solution follows (Yang, Antonante, Tzoumas & Carlone, "Graduated
Non-Convexity for Robust Spatial Perception", RA-L 5(2), 2020; GTSAM's GncOptimizer). It needs no guess of
which are wrong to begin with, and is no proof either: with many more wrong measurements than right ones it
may end in another minimum.
"""

from collections.abc import Iterable, Sequence

import gtsam
import networkx as nx
import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.pose_graph.component import along_tree
from mapweave.merge.pose_graph.factors import Factors, RelativePose
from mapweave.merge.pose_graph.fragments import Fragment, fragment_by_node
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.optimization import ANCHOR_SIGMA, add_measurements

SURE = 0.5
"""Weight from which a measurement counts as right; at the end nearly all weights are 0 or 1."""


def inliers(fragments: Sequence[Fragment], links: Sequence[Link], gate: float) -> list[Link]:
    """The links that are right, component by component.

    Args:
        fragments: pieces of map; their own measurements are always inliers.
        links: between their nodes.
        gate: see `wrong_measurements`.
    """
    by_node = fragment_by_node(fragments)
    pieces: nx.Graph = nx.Graph()
    pieces.add_edges_from((by_node[link.a].name, by_node[link.b].name) for link in links)
    wrong: set[tuple[NodeId, NodeId]] = set()
    for names in nx.connected_components(pieces):
        inside = [fragment for fragment in fragments if fragment.name in names]
        own = [RelativePose(m.a, m.b, m.a_from_b) for fragment in inside for m in fragment.measurements]
        measurements = [link.measurement for link in links if by_node[link.a].name in names]
        anchor = min(names)
        start = by_node[anchor].graph.pose(anchor)
        wrong |= {(m.a, m.b) for m in wrong_measurements(anchor, start, [*own, *measurements], gate)}
    return [link for link in links if link.pair not in wrong]


def wrong_measurements(
    anchor: NodeId, anchor_pose: Pose2, measurements: Iterable[RelativePose], gate: float
) -> list[RelativePose]:
    """Find the robust measurements of one connected component that are wrong.

    Args:
        anchor: the node that is held.
        anchor_pose: where.
        measurements: those that are not robust are always inliers.
        gate: chi-square with 3 degrees of freedom above which a measurement is wrong.

    Returns:
        The wrong ones, in the order of their nodes; they depend on the set of measurements, not on its order.
    """
    ordered = sorted(measurements, key=lambda m: (m.a, m.b, m.a_from_b.mean.vector.tolist()))
    start = along_tree(anchor, anchor_pose, ordered)
    row = {node: k for k, node in enumerate(sorted(start))}
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for node, k in row.items():
        values.insert(k, gtsam.Pose2(*start[node].vector))
    tight = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_SIGMA)
    graph.add(gtsam.PriorFactorPose2(row[anchor], gtsam.Pose2(*anchor_pose.vector), tight))
    # GNC sets the weights itself: its factors must have plain noise.
    factors = Factors.of(ordered, [row[m.a] for m in ordered], [row[m.b] for m in ordered])
    add_measurements(graph, factors)
    inliers = [0] + [k for k, m in enumerate(ordered, 1) if not m.robust]
    if len(inliers) == 1 + len(ordered):
        return []
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(inliers)
    optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
    # A factor's cost is half its squared residual.
    optimizer.setInlierCostThresholds(0.5 * gate)
    optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())[1:]
    return [m for m, weight in zip(ordered, weights, strict=True) if weight < SURE]
