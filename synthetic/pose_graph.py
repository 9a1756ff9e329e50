"""Pose graphs of others: split among robots, and GTSAM's batch optimum of them."""

from collections.abc import Mapping

import gtsam
import numpy as np

from mapweave.formats.g2o import G2oEdge, G2oGraph
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.fleet import BARE, CAMERA

WEIGHT = 20.0
"""Landmarks behind each link: files have none, so all get the same."""


def split(graph: G2oGraph, robots: int) -> tuple[dict[MapId, HybridMap], list[Link], dict[int, NodeId]]:
    """Cut a graph into as many runs of numbers as there are robots.

    Returns:
        The maps, which hold the edges between successive vertices; all other edges as links, one a pair (the
        surest); and the node of each vertex.
    """
    numbers = sorted(graph.poses)
    owner = {k: f"r{robots * seat // len(numbers)}" for seat, k in enumerate(numbers)}
    nodes = {k: NodeId(owner[k], 1, k) for k in numbers}
    maps = {MapId(agent, 1): HybridMap() for agent in sorted(set(owner.values()))}
    nowhere = np.zeros((3, 3))
    for k in numbers:
        pose = PoseGaussian(graph.poses[k], nowhere)
        maps[nodes[k].map].apply(NodePut(Node(nodes[k], k, pose, CAMERA, BARE)))
    links: dict[tuple[NodeId, NodeId], Link] = {}
    for number, edge in enumerate(graph.edges):
        a, b = nodes[edge.i], nodes[edge.j]
        between = PoseGaussian(edge.i_from_j, edge.covariance)
        if a.map == b.map and abs(edge.i - edge.j) == 1:
            # Numbers of edges come after those of all nodes.
            edge_id = EdgeId(a.agent, a.epoch, max(numbers) + 1 + number)
            maps[a.map].apply(EdgePut(Edge(edge_id, a, b, between, EdgeKind.MAPPED)))
            continue
        link = Link(a, b, between, evidence={"inliers": WEIGHT, "share": 1.0}).canonical()
        existing = links.get(link.pair)
        if existing is None or between.covariance.trace() < existing.a_from_b.covariance.trace():
            links[link.pair] = link
    return maps, list(links.values()), nodes


def factors_of(graph: G2oGraph, diagonal: bool = False) -> gtsam.NonlinearFactorGraph:
    """The file's edges with the file's own information, or its diagonal only; the first vertex is held."""
    out = gtsam.NonlinearFactorGraph()
    for edge in graph.edges:
        noise = gtsam.noiseModel.Gaussian.Information(edge.information)
        if diagonal:
            noise = gtsam.noiseModel.Diagonal.Precisions(np.diag(edge.information).copy())
        out.add(gtsam.BetweenFactorPose2(edge.i, edge.j, _pose(edge), noise))
    first = min(graph.poses)
    held = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    out.add(gtsam.PriorFactorPose2(first, gtsam.Pose2(), held))
    return out


def batch_optimum(graph: G2oGraph) -> float:
    """Chi-square at GTSAM's optimum, begun where the headings by themselves are best (LAGO)."""
    factors, start = factors_of(graph), gtsam.lago.initialize(factors_of(graph, diagonal=True))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-9)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, start, parameters)
    return 2.0 * float(factors.error(optimizer.optimize()))


def chi2_of(
    factors: gtsam.NonlinearFactorGraph, merged: MergedMap, nodes: Mapping[int, NodeId]
) -> float | None:
    """Chi-square of all the file's edges, the refused ones too, at a merge; None if it is in pieces."""
    if len(merged.components) != 1:
        return None
    poses = {k: merged.poses[node].merged_from_robot.mean for k, node in nodes.items()}
    back = poses[min(poses)].inverse()
    values = gtsam.Values()
    for k, pose in poses.items():
        values.insert(k, _as_gtsam(back @ pose))
    return 2.0 * float(factors.error(values))


def _pose(edge: G2oEdge) -> gtsam.Pose2:
    return _as_gtsam(edge.i_from_j)


def _as_gtsam(pose: Pose2) -> gtsam.Pose2:
    return gtsam.Pose2(pose.x, pose.y, pose.heading)
