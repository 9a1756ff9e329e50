"""The mapping filter's state as a value: what the wheels do to it, and what an image does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.ekf.motion import move_posture, move_rays
from agent.observation import Odometry
from hybridmap.pose import Array, Pose2, PoseGaussian


@dataclass(frozen=True, eq=False)
class MovingState:
    """Posture since the anchor and landmarks in the moving camera, with their joint covariance.

    Attributes:
        posture: (3,) [x m, y m, heading rad], anchor_from_robot.
        rays: (n, 3) [a, b, w 1/m] in the camera as it stands now.
        covariance: (3 + 3n, 3 + 3n) of [posture, rays], additive errors.
    """

    posture: Array
    rays: Array
    covariance: Array

    @staticmethod
    def at_anchor() -> MovingState:
        """At the anchor with certainty (the paper's P_0^r = 0), without landmarks."""
        return MovingState(np.zeros(3), np.zeros((0, 3)), np.zeros((3, 3)))

    @property
    def pose(self) -> PoseGaussian:
        """`anchor_from_robot`, perturbed on the right as everywhere outside the filter."""
        posture = Pose2.from_vector(self.posture)
        turn = np.eye(3)
        turn[:2, :2] = posture.rotation.T
        return PoseGaussian(posture, turn @ self.covariance[:3, :3] @ turn.T)

    @property
    def blocks(self) -> Array:
        """(n, 3, 3) covariance of each landmark by itself."""
        n = len(self.rays)
        index = np.arange(n)
        blocks: Array = self.covariance[3:, 3:].reshape(n, 3, n, 3)[index, :, index, :]
        return blocks

    def grown(self, rays: Array, variances: Array) -> MovingState:
        """The state with further landmarks, rays and variances (N, 3), independent of all that is there."""
        size, more = len(self.covariance), rays.size
        covariance = np.zeros((size + more, size + more))
        covariance[:size, :size] = self.covariance
        index = np.arange(size, size + more)
        covariance[index, index] = variances.ravel()
        return MovingState(self.posture, np.concatenate([self.rays, rays]), covariance)

    def kept(self, mask: NDArray[np.bool_]) -> MovingState:
        """The state with only some of its landmarks."""
        index = np.concatenate([[0, 1, 2], 3 + np.flatnonzero(np.repeat(mask, 3))])
        return MovingState(self.posture, self.rays[mask], self.covariance[np.ix_(index, index)])

    def reanchored(self) -> MovingState:
        """The state with the present posture as anchor: exact, as landmarks are in the robot's frame."""
        covariance = self.covariance.copy()
        covariance[:3, :] = covariance[:, :3] = 0.0
        return MovingState(np.zeros(3), self.rays, covariance)

    def corrected(self, index: NDArray[np.intp], residual: Array, information: Array) -> MovingState:
        """Kalman update by direct measurements of some entries of the state.

        Args:
            index: (K,) which entries.
            residual: (K,) measured minus expected.
            information: (K, K) inverse of the residuals' joint covariance.
        """
        columns = self.covariance[:, index]
        step = columns @ (information @ residual)
        # A product with its own transpose stays symmetric to the last bit.
        root = columns @ np.linalg.cholesky(information)
        covariance = self.covariance - root @ root.T
        return MovingState(self.posture + step[:3], self.rays + step[3:].reshape(-1, 3), covariance)


@dataclass(frozen=True, eq=False)
class Step:
    """One step of the wheels, linearised where it seems to have gone, until an image has judged it.

    Attributes:
        before: state before the step.
        measured: what the wheels say.
        wheel_root: (2, 2) root of the covariance S of (u1, u2).
        posture_variances: (3,) process noise of the posture, the diagonal of Q.
        mount_forward: of the optical centre ahead of the axle, m.
        at: where the step is linearised: as measured, or a better guess.
        state: after the step.
        scale: (n,) depth after over depth before; not positive for landmarks now behind the camera.
        by_input: (3 + 3n, 2) Jacobian of the state by (u1, u2).
    """

    before: MovingState
    measured: Odometry
    wheel_root: Array
    posture_variances: Array
    mount_forward: float
    at: Odometry
    state: MovingState
    scale: Array
    by_input: Array

    @staticmethod
    def predict(
        before: MovingState,
        measured: Odometry,
        wheel_root: Array,
        posture_variances: Array,
        mount_forward: float,
        at: Odometry | None = None,
    ) -> Step:
        """Predict: P- = A P A^T + B S B^T + Q of paper-notes, with the exact motion."""
        at = at or measured
        n = len(before.rays)
        posture, by_posture, posture_by_input = move_posture(before.posture, at)
        moved = move_rays(before.rays, at, mount_forward)
        by_input = np.concatenate([posture_by_input, moved.by_input.reshape(3 * n, 2)])
        shift = by_input @ np.array([measured.forward - at.forward, measured.turn - at.turn])
        old = before.covariance
        new = np.empty_like(old)
        new[:3, :3] = by_posture @ old[:3, :3] @ by_posture.T
        # The transition is block diagonal: 3x3 blocks times rows, never the dense product.
        new[3:, :3] = (moved.by_ray @ (by_posture @ old[:3, 3:]).T.reshape(n, 3, 3)).reshape(3 * n, 3)
        new[:3, 3:] = new[3:, :3].T
        half = (moved.by_ray @ old[3:, 3:].reshape(n, 3, 3 * n)).reshape(3 * n, 3 * n)
        new[3:, 3:] = (moved.by_ray @ half.T.reshape(n, 3, 3 * n)).reshape(3 * n, 3 * n)
        root = by_input @ wheel_root
        new += root @ root.T
        new[[0, 1, 2], [0, 1, 2]] += posture_variances
        rays = moved.rays + shift[3:].reshape(n, 3)
        state = MovingState(posture + shift[:3], rays, 0.5 * (new + new.T))
        return Step(
            before, measured, wheel_root, posture_variances, mount_forward, at, state, moved.scale, by_input
        )

    def again(self, at: Odometry | None = None, wheel_root: Array | None = None) -> Step:
        """The same step linearised elsewhere, or with the wheels believed less."""
        root = self.wheel_root if wheel_root is None else wheel_root
        return Step.predict(
            self.before, self.measured, root, self.posture_variances, self.mount_forward, at or self.at
        )

    def wheel_errors(self, index: NDArray[np.intp], pull: Array) -> Array:
        """(2,) what the two wheels most likely erred by, in sigmas, given measurements of the state after.

        Args:
            index: (K,) which entries of the state were measured.
            pull: (K,) inverse of the residuals' joint covariance, times the residuals.
        """
        errors: Array = self.wheel_root.T @ (self.by_input[index].T @ pull)
        return errors

    def likely(self, errors: Array) -> Odometry:
        """What the robot most likely did if the wheels erred so, (2,) in sigmas."""
        u = self.wheel_root @ errors
        return Odometry(self.measured.forward + float(u[0]), self.measured.turn + float(u[1]))

    def kept(self, mask: NDArray[np.bool_]) -> Step:
        """The step of only some of the landmarks."""
        if mask.all():
            return self
        rows = np.concatenate([[True, True, True], np.repeat(mask, 3)])
        return replace(
            self,
            before=self.before.kept(mask),
            state=self.state.kept(mask),
            scale=self.scale[mask],
            by_input=self.by_input[rows],
        )
