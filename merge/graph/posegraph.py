"""Postures that agree best with all measured relative postures: a GTSAM pose graph, and its covariance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import networkx as nx
import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from hybridmap.node import MapId, NodeId
from hybridmap.pose import Array, Pose2, PoseGaussian, nearest_covariance
from hybridmap.recognising.pose_arrays import PoseGaussians, adjoints, compose_poses, inverse_poses

LEAST_SIGMAS = np.array([1e-3, 1e-3, 2e-4])
"""No measurement is better than this, m, m, rad: it keeps the graph well conditioned."""

LEAST_SHARE = 2e-6
"""Nor is any direction better known than by this share of the covariance's trace: what is told of it may be
off by half as much (`hybridmap.pose`), and nothing smaller comes through the solver."""

ANCHOR_SIGMA = 1e-5

HUBER = 2.0
"""Normalised residual from which a measurement that may be wrong pulls no harder."""

AT_ONCE = 256
"""Nodes whose marginal covariances are solved for together: all at once would take memory by the square."""

FEW = 2048
"""Up to as many nodes have their marginal covariances worked out all at once when one is asked for."""

TOLERANCE = 1e-9
"""The solver stops when a step makes the cost smaller by less than this, absolutely or as a share of it."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """A relative posture.

    Attributes:
        a: one node.
        b: another one.
        a_from_b: posture of b in a.
        robust: whether it may be wrong: then its pull is limited (Huber).
    """

    a: NodeId
    b: NodeId
    a_from_b: PoseGaussian
    robust: bool = False

    @property
    def covariance(self) -> Array:
        """(3, 3), not better than is believable."""
        return believable(self.a_from_b.covariance)


def believable(covariances: Array) -> Array:
    """(..., 3, 3) covariances of measurements, each made as large as is believable."""
    share = LEAST_SHARE * np.trace(covariances, axis1=-2, axis2=-1)
    least = np.maximum(LEAST_SIGMAS**2, share[..., None])
    out: Array = covariances + least[..., None] * np.eye(3)
    return out


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """A solved graph of one connected component.

    Attributes:
        anchor: the node that is held.
        nodes: in the order of ids.
        means: (N, 3) m, m, rad, postures of the nodes.
        information: (3N, 3N) sparse, of the right perturbations of all nodes, anchor held.
        huber: normalised residual from which a robust measurement pulled no harder; inf: none did.
    """

    anchor: NodeId
    nodes: tuple[NodeId, ...]
    means: Array
    information: sparse.csc_matrix
    huber: float = HUBER

    @cached_property
    def rows(self) -> dict[NodeId, int]:
        """Row of each node."""
        return {node: k for k, node in enumerate(self.nodes)}

    @cached_property
    def _factor(self) -> Any:
        """Sparse factor of the information, for as many covariances as are asked for."""
        return factorized(self.information)

    def index(self, nodes: Sequence[NodeId]) -> NDArray[np.int64]:
        """(K,) rows of nodes."""
        return np.array([self.rows[node] for node in nodes], dtype=np.int64)

    def pose(self, node: NodeId) -> Pose2:
        """The posture of a node."""
        return Pose2.from_vector(self.means[self.rows[node]])

    def covariance(self, nodes: Sequence[NodeId]) -> Array:
        """(K, 3, K, 3) joint covariance of some nodes, by solving for their columns only."""
        columns = (3 * self.index(nodes)[:, None] + np.arange(3)).ravel()
        right = np.zeros((self.information.shape[0], len(columns)))
        right[columns, np.arange(len(columns))] = 1.0
        joint = self._factor.solve(right)[columns]
        joint = 0.5 * (joint + joint.T)
        blocks: Array = joint.reshape(len(nodes), 3, len(nodes), 3)
        return blocks

    @cached_property
    def maps(self) -> frozenset[MapId]:
        """Of which maps there are nodes."""
        return frozenset(MapId(agent, epoch) for agent, epoch in {node[:2] for node in self.nodes})

    @cached_property
    def _known(self) -> dict[NodeId, PoseGaussian]:
        """Postures that were asked for: all at once where they are few, else one by one."""
        return self.postures() if len(self.nodes) <= FEW else {}

    def posture(self, node: NodeId) -> PoseGaussian:
        """A node's posture with its marginal covariance."""
        known = self._known
        if node not in known:
            known[node] = PoseGaussian(
                self.pose(node), nearest_covariance(self.covariance([node])[0, :, 0, :])
            )
        return known[node]

    def postures(self) -> dict[NodeId, PoseGaussian]:
        """Each node's posture with its marginal covariance."""
        out: dict[NodeId, PoseGaussian] = {}
        for first in range(0, len(self.nodes), AT_ONCE):
            some = self.nodes[first : first + AT_ONCE]
            joint = self.covariance(some)
            for k, node in enumerate(some):
                covariance = nearest_covariance(joint[k, :, k, :])
                out[node] = PoseGaussian(Pose2.from_vector(self.means[first + k]), covariance)
        return out

    def relative(self, starts: Sequence[NodeId], ends: Sequence[NodeId]) -> PoseGaussians:
        """Postures `start_from_end` of K pairs, with covariances that know what the two have in common."""
        involved = sorted({*starts, *ends})
        joint = self.covariance(involved)
        row = {node: k for k, node in enumerate(involved)}
        i, j = np.array([row[n] for n in starts], int), np.array([row[n] for n in ends], int)
        means = compose_poses(inverse_poses(self.means[self.index(starts)]), self.means[self.index(ends)])
        # (start @ ds)^-1 (end @ de) = start_from_end @ (de - Ad(end_from_start) ds) to first order.
        ad = -adjoints(inverse_poses(means))
        cross = ad @ joint[i, :, j, :]
        covariances = ad @ joint[i, :, i, :] @ ad.transpose(0, 2, 1) + joint[j, :, j, :]
        return PoseGaussians(means, covariances + cross + cross.transpose(0, 2, 1))


def factorized(information: sparse.spmatrix) -> Any:
    """Sparse factor of a symmetric positive definite matrix, which needs no pivots."""
    return splu(
        sparse.csc_matrix(information),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def solve_graph(
    anchor: NodeId,
    anchor_pose: Pose2,
    measurements: Iterable[Measurement],
    guesses: Mapping[NodeId, Pose2] | None = None,
    huber: float = HUBER,
) -> PoseGraph:
    """Optimise one connected component.

    Args:
        anchor: the node that is held.
        anchor_pose: where.
        measurements: what is known; those that do not connect to the anchor are left out.
        guesses: where to start; else along a tree of the most certain measurements.
        huber: normalised residual from which a robust measurement pulls no harder; inf: plain least squares.

    Returns:
        The solved graph. It depends on the set of measurements, not on their order.
    """
    problem = Problem.of(anchor, anchor_pose, measurements, guesses, huber)
    values = problem.values
    if len(problem.measurements) >= len(problem.nodes):
        # A tree is at its optimum already.
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(TOLERANCE)
        parameters.setAbsoluteErrorTol(TOLERANCE)
        values = gtsam.LevenbergMarquardtOptimizer(problem.graph, values, parameters).optimize()
    return problem.solved(values)


@dataclass(frozen=True, eq=False)
class Problem:
    """What GTSAM is asked to solve.

    Attributes:
        anchor: the node that is held.
        nodes: in the order of ids; a node's row is its key.
        measurements: in the order of their factors, which come after that of the anchor.
        graph: the factors.
        values: where to start.
        huber: of robust measurements.
    """

    anchor: NodeId
    nodes: tuple[NodeId, ...]
    measurements: tuple[Measurement, ...]
    graph: Any
    values: Any
    huber: float

    @staticmethod
    def of(
        anchor: NodeId,
        anchor_pose: Pose2,
        measurements: Iterable[Measurement],
        guesses: Mapping[NodeId, Pose2] | None = None,
        huber: float = HUBER,
    ) -> Problem:
        """See `solve_graph`."""
        ordered = sorted(measurements, key=lambda m: (m.a, m.b, m.a_from_b.mean.vector.tolist()))
        start = _along_tree(anchor, anchor_pose, ordered)
        ordered = [m for m in ordered if m.a in start]
        nodes = tuple(sorted(start))
        row = {node: k for k, node in enumerate(nodes)}
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for node in nodes:
            guess = (guesses or {}).get(node, start[node]) if node != anchor else anchor_pose
            values.insert(row[node], gtsam.Pose2(guess.x, guess.y, guess.heading))
        held = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_SIGMA)
        place = gtsam.Pose2(anchor_pose.x, anchor_pose.y, anchor_pose.heading)
        graph.add(gtsam.PriorFactorPose2(row[anchor], place, held))
        for m in ordered:
            noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(m.covariance)
            if m.robust and math.isfinite(huber):
                noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(huber), noise)
            mean = m.a_from_b.mean
            between = gtsam.Pose2(mean.x, mean.y, mean.heading)
            graph.add(gtsam.BetweenFactorPose2(row[m.a], row[m.b], between, noise))
        return Problem(anchor, nodes, tuple(ordered), graph, values, huber)

    def solved(self, values: Any) -> PoseGraph:
        """The graph at GTSAM's optimum."""
        poses = (values.atPose2(k) for k in range(len(self.nodes)))
        means = np.array([[p.x(), p.y(), p.theta()] for p in poses])
        row = {node: k for k, node in enumerate(self.nodes)}
        information = _information(row, self.anchor, means, self.measurements, self.huber)
        return PoseGraph(self.anchor, self.nodes, means, information, self.huber)


def _along_tree(
    anchor: NodeId, anchor_pose: Pose2, measurements: Sequence[Measurement]
) -> dict[NodeId, Pose2]:
    """Postures along a minimum spanning tree of uncertainty."""
    graph: nx.Graph = nx.Graph()
    graph.add_node(anchor)
    for m in measurements:
        weight = float(m.covariance.trace()) + (100.0 if m.robust else 0.0)
        known = graph.get_edge_data(m.a, m.b)
        if m.a != m.b and (known is None or weight < known["weight"]):
            graph.add_edge(m.a, m.b, weight=weight, measurement=m)
    tree = nx.minimum_spanning_tree(graph.subgraph(nx.node_connected_component(graph, anchor)))
    found = {anchor: anchor_pose}
    for known_node, node in nx.bfs_edges(tree, anchor):
        m = tree.edges[known_node, node]["measurement"]
        relative = m.a_from_b.mean if m.a == known_node else m.a_from_b.mean.inverse()
        found[node] = found[known_node] @ relative
    return found


def _information(
    row: Mapping[NodeId, int], anchor: NodeId, means: Array, measurements: Sequence[Measurement], huber: float
) -> sparse.csc_matrix:
    """Information of all right perturbations; a residual's derivative is (-Ad(b_from_a), identity)."""
    n = len(means)
    diagonal = np.zeros(3 * n)
    diagonal[3 * row[anchor] : 3 * row[anchor] + 3] = ANCHOR_SIGMA**-2
    held = sparse.diags(diagonal, format="csc")
    if not measurements:
        return held
    a = np.array([row[m.a] for m in measurements])
    b = np.array([row[m.b] for m in measurements])
    b_from_a = compose_poses(inverse_poses(means[b]), means[a])
    by_a = -adjoints(b_from_a)
    weights = np.linalg.inv(np.stack([m.covariance for m in measurements]))
    measured = np.stack([m.a_from_b.mean.vector for m in measurements])
    residuals = compose_poses(inverse_poses(measured), inverse_poses(b_from_a))
    size = np.sqrt(np.einsum("ni,nij,nj->n", residuals, weights, residuals))
    robust = np.array([m.robust for m in measurements])
    held_back = robust & (size > huber)
    weights[held_back] *= (huber / size[held_back])[:, None, None]
    transposed = by_a.transpose(0, 2, 1)
    blocks = np.concatenate([transposed @ weights @ by_a, transposed @ weights, weights @ by_a, weights])
    rows, columns = np.concatenate([a, a, b, b]), np.concatenate([a, b, a, b])
    k = np.arange(3)
    i = np.broadcast_to(3 * rows[:, None, None] + k[:, None], blocks.shape)
    j = np.broadcast_to(3 * columns[:, None, None] + k, blocks.shape)
    entries = (blocks.ravel(), (i.ravel(), j.ravel()))
    return sparse.csc_matrix(sparse.coo_matrix(entries, shape=(3 * n, 3 * n)) + held)
