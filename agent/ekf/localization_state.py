"""The localization filter's state as a value, and what changes its shape or its frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.inverse_depth import points_of_rays
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian

NEAREST_SCALE = 1e-3
"""A landmark whose depth has shrunk to this share of its depth at the node counts as behind the camera."""


@dataclass(frozen=True, eq=False)
class LocalizationState:
    """Pose in a node and the node's landmarks, with their joint covariance.

    Attributes:
        pose_vector: (3,) [x m, y m, heading rad], node_from_robot.
        rays: (n, 3) [a, b, w 1/m] at the node. The paper's two numbers a landmark, here a and w, are
            estimated; b is known as the map gives it, and only its uncertainty is considered.
        first: (n, 3) the rays as the map gives them. All Jacobians are taken there: at estimates that
            change from image to image the filter would gain information that no image has (first-estimates
            Jacobians, Huang, Mourikis and Roumeliotis 2010).
        covariance: (3 + 3n, 3 + 3n) of [pose, (a, b, w) of each landmark], additive errors.
    """

    pose_vector: Array
    rays: Array
    first: Array
    covariance: Array

    @staticmethod
    def of_prior(prior: PoseGaussian, rays: Array, covariances: Array) -> LocalizationState:
        """A pose, and landmarks that know nothing of it.

        Args:
            prior: node_from_robot.
            rays: (n, 3) [a, b, w 1/m] at the node.
            covariances: (n, 3, 3) of these.
        """
        n, turn = len(rays), turning(prior.mean)
        covariance = np.zeros((3 + 3 * n, 3 + 3 * n))
        covariance[:3, :3] = turn @ prior.covariance @ turn.T
        index = np.arange(n)
        covariance[3:, 3:].reshape(n, 3, n, 3)[index, :, index, :] = covariances
        return LocalizationState(prior.mean.vector, rays, rays, covariance)

    @property
    def pose(self) -> PoseGaussian:
        """`node_from_robot`, perturbed on the right as everywhere outside the filter."""
        mean = Pose2.from_vector(self.pose_vector)
        turn = turning(mean).T
        return PoseGaussian(mean, turn @ self.covariance[:3, :3] @ turn.T)

    def points(self, camera: Camera) -> tuple[Array, Array]:
        """Landmarks (n, 3) m in the node's robot frame and their covariances; NaN where w <= 0."""
        n = len(self.rays)
        index = np.arange(n)
        points, by_ray = points_of_rays(self.rays, camera.mount_forward, camera.mount_height)
        blocks = self.covariance[3:, 3:].reshape(n, 3, n, 3)[index, :, index, :]
        return points, by_ray @ blocks @ np.swapaxes(by_ray, 1, 2)

    def depths(self) -> tuple[Array, Array]:
        """Depths of the landmarks at the node, and standard deviations by which they may be kept one by one.

        The errors of depths learned from the same images are correlated. Taken as independent, they would
        make the next drive learn too much from them. Independent
        errors that are together no smaller than the joint ones have the standard deviations
        sigma_i sqrt(sum_j |rho_ij|): their covariance less the joint one is diagonally dominant.

        Returns:
            (n,) m along the optical axis, infinite where w <= 0; (n,) m.
        """
        w, joint = self.rays[:, 2], self.covariance[5::3, 5::3]
        ahead = w > 0.0
        depths = np.where(ahead, 1.0 / np.where(ahead, w, 1.0), np.inf)
        sigmas = np.sqrt(np.maximum(np.diag(joint), 1e-300))
        common = np.abs(joint / np.outer(sigmas, sigmas)).sum(axis=1)
        return depths, np.where(ahead, depths**2, np.inf) * sigmas * np.sqrt(common)

    def stepped(self, step: Array) -> tuple[Array, Array]:
        """Pose and rays after a step (3 + 3n,) of the state; the slopes b stay."""
        rays = self.rays.copy()
        rays[:, 0] += step[3::3]
        rays[:, 2] += step[5::3]
        return self.pose_vector + step[:3], rays

    def corrected(self, step: Array, root: Array) -> LocalizationState:
        """The state after an update by a step (3 + 3n,), whose gain takes `root root^T` off the covariance.

        The slopes b do not follow, so the covariance among them stays as it is (Schmidt's consider filter);
        all else is as in the full filter.
        """
        pose_vector, rays = self.stepped(step)
        covariance = self.covariance - root @ root.T
        covariance[4::3, 4::3] = self.covariance[4::3, 4::3]
        return LocalizationState(pose_vector, rays, self.first, covariance)

    def of_unknown_scale(self, share: float) -> LocalizationState:
        """The state where all lengths may be off together by a share of them."""
        change = np.zeros(len(self.covariance))
        change[:2] = share * self.pose_vector[:2]
        change[5::3] = -share * self.rays[:, 2]
        return LocalizationState(
            self.pose_vector, self.rays, self.first, self.covariance + np.outer(change, change)
        )

    def kept(self, mask: NDArray[np.bool_]) -> LocalizationState:
        """The state with only some of its landmarks, by a mask (n,)."""
        index = np.concatenate([[0, 1, 2], 3 + np.flatnonzero(np.repeat(mask, 3))])
        return LocalizationState(
            self.pose_vector, self.rays[mask], self.first[mask], self.covariance[np.ix_(index, index)]
        )


def turning(pose: Pose2) -> Array:
    """(3, 3) that turns errors (x, y, heading) of the moving frame into the fixed frame."""
    turn = np.eye(3)
    turn[:2, :2] = pose.rotation
    return turn
