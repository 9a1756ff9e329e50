"""The localization filter's state as a value, and what changes its shape or its frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.ekf.anchored import Sight, points_of_rays, see
from hybridmap.camera import Camera
from hybridmap.pose import Array, Pose2, PoseGaussian

NEAREST_SCALE = 1e-3
"""A landmark whose depth has shrunk to this share of its depth at the node counts as behind the camera."""


@dataclass(frozen=True, eq=False)
class NodeState:
    """Posture in a node and the node's landmarks, with their joint covariance.

    Attributes:
        posture: (3,) [x m, y m, heading rad], node_from_robot.
        rays: (n, 3) [a, b, w 1/m] at the node; b is no state but follows (a, w).
        slope: (n, 2) derivative of b by (a, w).
        slope_variance: (n,) what remains uncertain of b when (a, w) is known.
        covariance: (3 + 2n, 3 + 2n) of [posture, (a, w) of each landmark], additive errors.
    """

    posture: Array
    rays: Array
    slope: Array
    slope_variance: Array
    covariance: Array

    @staticmethod
    def of_prior(prior: PoseGaussian) -> NodeState:
        """A posture and no landmarks."""
        turn = turning(prior.mean)
        return NodeState(
            prior.mean.vector,
            np.zeros((0, 3)),
            np.zeros((0, 2)),
            np.zeros(0),
            turn @ prior.covariance @ turn.T,
        )

    @property
    def pose(self) -> PoseGaussian:
        """`node_from_robot`, perturbed on the right as everywhere outside the filter."""
        mean = Pose2.from_vector(self.posture)
        turn = turning(mean).T
        return PoseGaussian(mean, turn @ self.covariance[:3, :3] @ turn.T)

    def points(self, camera: Camera) -> tuple[Array, Array]:
        """Landmarks (n, 3) m in the node's robot frame and their covariances; NaN where w <= 0."""
        n = len(self.rays)
        index = np.arange(n)
        points, by_ray = points_of_rays(self.rays, camera.mount_forward, camera.mount_height)
        pairs = self.covariance[3:, 3:].reshape(n, 2, n, 2)[index, :, index, :]
        from_pair = np.zeros((n, 3, 2))
        from_pair[:, 0, 0] = from_pair[:, 2, 1] = 1.0
        from_pair[:, 1] = self.slope
        spread = from_pair @ pairs @ np.swapaxes(from_pair, 1, 2)
        spread[:, 1, 1] += self.slope_variance
        return points, by_ray @ spread @ np.swapaxes(by_ray, 1, 2)

    def by_pair(self, sight: Sight, slots: NDArray[np.intp]) -> Array:
        """(N, 3, 2) Jacobian of the rays that some landmarks are seen at, by (a, w) with b following."""
        out: Array = sight.by_ray[:, :, [0, 2]] + sight.by_ray[:, :, 1:2] * self.slope[slots][:, None, :]
        return out

    def stepped(self, step: Array) -> tuple[Array, Array]:
        """Posture and rays after a step (3 + 2n,) of the state."""
        pairs = step[3:].reshape(-1, 2)
        rays = self.rays.copy()
        rays[:, [0, 2]] += pairs
        rays[:, 1] += (self.slope * pairs).sum(axis=1)
        return self.posture + step[:3], rays

    def grown(self, rays: Array, covariances: Array, by_posture: Array) -> NodeState:
        """The state with further landmarks.

        Args:
            rays: (N, 3) [a, b, w 1/m] at the node.
            covariances: (N, 3, 3) of their own errors, independent of the state.
            by_posture: (N, 3, 3) how the posture's error enters them besides.
        """
        size, n = len(self.covariance), len(rays)
        total = covariances + by_posture @ self.covariance[:3, :3] @ np.swapaxes(by_posture, 1, 2)
        pairs = total[:, [0, 2]][:, :, [0, 2]]
        slope = np.linalg.solve(pairs, total[:, [0, 2], 1:2])[:, :, 0]
        variance = np.maximum(total[:, 1, 1] - (slope * total[:, [0, 2], 1]).sum(axis=1), 0.0)
        lever = by_posture[:, [0, 2]].reshape(2 * n, 3)
        grown = np.zeros((size + 2 * n, size + 2 * n))
        grown[:size, :size] = self.covariance
        grown[size:, :size] = lever @ self.covariance[:3]
        grown[:size, size:] = grown[size:, :size].T
        # The posture's share is common to all new landmarks, their own is not.
        grown[size:, size:] = lever @ self.covariance[:3, :3] @ lever.T
        own = grown[size:, size:].reshape(n, 2, n, 2)
        index = np.arange(n)
        own[index, :, index, :] += covariances[:, [0, 2]][:, :, [0, 2]]
        return NodeState(
            self.posture,
            np.concatenate([self.rays, rays]),
            np.concatenate([self.slope, slope]),
            np.concatenate([self.slope_variance, variance]),
            grown,
        )

    def kept(self, mask: NDArray[np.bool_]) -> NodeState:
        """The state with only some of its landmarks."""
        index = np.concatenate([[0, 1, 2], 3 + np.flatnonzero(np.repeat(mask, 2))])
        return NodeState(
            self.posture,
            self.rays[mask],
            self.slope[mask],
            self.slope_variance[mask],
            self.covariance[np.ix_(index, index)],
        )

    def rebased(
        self, new_from_node: PoseGaussian, mount_forward: float
    ) -> tuple[NodeState, NDArray[np.bool_]]:
        """The state in another node's frame, whose error enters all of it alike.

        Args:
            new_from_node: where this node stands in the other, independent of the state.
            mount_forward: of the optical centre ahead of the axle, m.

        Returns:
            The state, and (n,) which of its landmarks mean something there (are ahead of the other node).
        """
        n = len(self.rays)
        node_from_new = new_from_node.inverse()
        at = node_from_new.mean.vector
        turn = turning(node_from_new.mean)
        edge = turn @ node_from_new.covariance @ turn.T
        seen = see(at, self.rays, mount_forward)
        blocks = self.by_pair(seen, np.arange(n))
        by_pair = blocks[:, [0, 2]]
        by_edge = np.empty((3 + 2 * n, 3))
        away = turn[:2, :2].T @ (self.posture[:2] - at[:2])
        by_edge[:3] = -turn.T
        by_edge[:2, 2] = away[1], -away[0]
        by_edge[3:] = seen.by_posture[:, [0, 2]].reshape(2 * n, 3)
        p = self.covariance
        moved = np.empty_like(p)
        moved[:3, :3] = turn.T @ p[:3, :3] @ turn
        moved[3:, :3] = (by_pair @ (turn.T @ p[:3, 3:]).T.reshape(n, 2, 3)).reshape(2 * n, 3)
        moved[:3, 3:] = moved[3:, :3].T
        half = (by_pair @ p[3:, 3:].reshape(n, 2, 2 * n)).reshape(2 * n, 2 * n)
        moved[3:, 3:] = (by_pair @ half.T.reshape(n, 2, 2 * n)).reshape(2 * n, 2 * n)
        moved += by_edge @ edge @ by_edge.T
        ahead = (seen.scale > NEAREST_SCALE) & (np.abs(np.linalg.det(by_pair)) > 1e-12)
        # b as a function of the new (a, w), and what the edge's error leaves over.
        solvable = np.where(ahead[:, None, None], np.swapaxes(by_pair, 1, 2), np.eye(2))
        slope = np.linalg.solve(solvable, blocks[:, 1, :, None])[:, :, 0]
        stray = seen.by_posture[:, 1] - np.einsum("nk,nkj->nj", slope, seen.by_posture[:, [0, 2]])
        variance = self.slope_variance * seen.by_ray[:, 1, 1] ** 2
        variance = variance + np.einsum("ni,ij,nj->n", stray, edge, stray)
        mean = new_from_node.mean @ Pose2.from_vector(self.posture)
        return NodeState(mean.vector, seen.rays, slope, variance, 0.5 * (moved + moved.T)), ahead


def turning(pose: Pose2) -> Array:
    """(3, 3) that turns errors (x, y, heading) of the moving frame into the fixed frame."""
    turn = np.eye(3)
    turn[:2, :2] = pose.rotation
    return turn
