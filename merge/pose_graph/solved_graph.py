"""A solved pose graph: where nodes are, and how well that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian, nearest_covariance
from mapweave.registration.pose_arrays import PoseGaussians, adjoints, compose_poses, inverse_poses

if TYPE_CHECKING:
    from scipy import sparse

AT_ONCE = 256
"""Nodes whose marginal covariances are solved for together: all at once would take memory by the square. In
graphs of up to FEW nodes; of larger ones they are worked out from each other."""

FEW = 2048
"""Up to as many nodes have their marginal covariances worked out all at once when one is asked for."""


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """A solved graph of one connected component.

    Attributes:
        anchor: the node that is held.
        nodes: in the order of ids.
        means: (N, 3) m, m, rad, poses of the nodes.
        information: (3N, 3N) sparse, of the right perturbations of all nodes, anchor held.
    """

    anchor: NodeId
    nodes: tuple[NodeId, ...]
    means: Array
    information: sparse.csc_matrix

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
        """The pose of a node."""
        return Pose2.from_vector(self.means[self.rows[node]])

    def covariance(self, nodes: Sequence[NodeId]) -> Array:
        """(K, 3, K, 3) joint covariance of some nodes, by solving for their columns only."""
        return self._joint(self.index(nodes))

    def _joint(self, rows: NDArray[np.int64]) -> Array:
        """(K, 3, K, 3) joint covariance of some rows."""
        columns = (3 * rows[:, None] + np.arange(3)).ravel()
        right = np.zeros((self.information.shape[0], len(columns)))
        right[columns, np.arange(len(columns))] = 1.0
        joint = self._factor.solve(right)[columns]
        joint = 0.5 * (joint + joint.T)
        blocks: Array = joint.reshape(len(rows), 3, len(rows), 3)
        return blocks

    @cached_property
    def maps(self) -> frozenset[MapId]:
        """The maps of which there are nodes."""
        return frozenset(MapId(agent, epoch) for agent, epoch in {node[:2] for node in self.nodes})

    @cached_property
    def _pose_gaussians(self) -> dict[NodeId, PoseGaussian]:
        """Poses that were asked for: all at once where they are few, else one by one."""
        return self.poses() if len(self.nodes) <= FEW else {}

    def pose_gaussian(self, node: NodeId) -> PoseGaussian:
        """A node's pose with its marginal covariance."""
        poses = self._pose_gaussians
        if node not in poses:
            poses[node] = PoseGaussian(
                self.pose(node), nearest_covariance(self.covariance([node])[0, :, 0, :])
            )
        return poses[node]

    def poses(self) -> dict[NodeId, PoseGaussian]:
        """Each node's pose with its marginal covariance."""
        out: dict[NodeId, PoseGaussian] = {}
        if len(self.nodes) > FEW:
            from mapweave.merge.pose_graph.marginal_covariances import marginal_covariances

            marginals = marginal_covariances(self.information)
            return {
                node: PoseGaussian(Pose2.from_vector(mean), nearest_covariance(covariance))
                for node, mean, covariance in zip(self.nodes, self.means, marginals, strict=True)
            }
        for first in range(0, len(self.nodes), AT_ONCE):
            some = self.nodes[first : first + AT_ONCE]
            joint = self.covariance(some)
            for k, node in enumerate(some):
                covariance = nearest_covariance(joint[k, :, k, :])
                out[node] = PoseGaussian(Pose2.from_vector(self.means[first + k]), covariance)
        return out

    def relative(self, starts: Sequence[NodeId], ends: Sequence[NodeId]) -> PoseGaussians:
        """Poses `start_from_end` of K pairs, with covariances that know what the two have in common."""
        return self.relative_rows(self.index(starts), self.index(ends))

    def relative_rows(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> PoseGaussians:
        """The same of (K,) rows: poses `i_from_j`."""
        means = compose_poses(inverse_poses(self.means[i]), self.means[j])
        involved, where = np.unique(np.concatenate([i, j]), return_inverse=True)
        first, second = np.split(where, 2)
        return PoseGaussians(means, relative_covariances(self._joint(involved), first, second, means))


def relative_covariances(joint: Array, i: NDArray[np.int64], j: NDArray[np.int64], i_from_j: Array) -> Array:
    """(K, 3, 3) covariances of the relative poses of K pairs of nodes.

    Args:
        joint: (N, 3, N, 3) covariance of nodes.
        i: (K,) of these.
        j: (K,) of these.
        i_from_j: (K, 3) relative poses.
    """
    # (start @ ds)^-1 (end @ de) = start_from_end @ (de - Ad(end_from_start) ds) to first order.
    ad = -adjoints(inverse_poses(i_from_j))
    cross = ad @ joint[i, :, j, :]
    covariances: Array = ad @ joint[i, :, i, :] @ ad.transpose(0, 2, 1) + joint[j, :, j, :]
    return covariances + cross + cross.transpose(0, 2, 1)


def factorized(information: sparse.spmatrix) -> Any:
    """Sparse factor of a symmetric positive definite matrix, which needs no pivots."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    return splu(
        sparse.csc_matrix(information),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
