"""The mapping filter's state as a value: what the wheels do to it, and what an image does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.ekf import kernels
from agent.observation import Odometry
from hybridmap.pose import Array, Pose2, PoseGaussian

Examined = tuple[Array, Array, float, float]
"""An image beside what was expected of it: what agent.ekf.algebra.examine returns."""


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

    def corrected(
        self, slots: NDArray[np.intp], residual: Array, whitening: Array
    ) -> tuple[MovingState, float]:
        """Kalman update by direct measurements of the slopes of some landmarks.

        Args:
            slots: (m,) which landmarks.
            residual: (m, 2) measured minus expected.
            whitening: (2m, 2m) what whitens the residuals.

        Returns:
            The state after, and the residuals' squared Mahalanobis norm.
        """
        posture, rays, covariance, squares = kernels.condition(
            self.posture, self.rays, self.covariance, slots, whitening, residual
        )
        return MovingState(posture, rays, covariance), squares


@dataclass(eq=False, slots=True)
class Step:
    """One step of the wheels, linearised where it seems to have gone, until an image has judged it.

    Attributes:
        before: state before the step.
        measured: what the wheels say.
        wheel_root: (2, 2) root of the covariance S of (u1, u2).
        side_slip: sigma of u3, m.
        posture_variances: (3,) process noise of the posture, the diagonal of Q.
        mount_forward: of the optical centre ahead of the axle, m.
        at: where the step is linearised: as measured, or a better guess.
        posture: (3,) expected after the step.
        rays: (n, 3) expected after the step.
    """

    before: MovingState
    measured: Odometry
    wheel_root: Array
    side_slip: float
    posture_variances: Array
    mount_forward: float
    at: Odometry
    posture: Array
    rays: Array
    _state: MovingState | None = None
    _by_input: Array | None = None

    @property
    def state(self) -> MovingState:
        """After the step: P- = A P A^T + B S B^T + Q of paper-notes; computed when first asked for."""
        if self._state is None:
            at, measured = self.at, self.measured
            posture, rays, self._by_input, covariance = kernels.advance(
                self.before.posture, self.before.rays, self.before.covariance, (at.forward, at.turn),
                (measured.forward, measured.turn), self.mount_forward, self.wheel_root, self.side_slip,
                self.posture_variances,
            )  # fmt: skip
            self.posture, self.rays = posture, rays
            self._state = MovingState(posture, rays, covariance)
        return self._state

    def again(self, at: Odometry | None = None, wheel_root: Array | None = None) -> Step:
        """The same step linearised elsewhere, or with the wheels believed less."""
        step = Step(
            self.before, self.measured, self.wheel_root if wheel_root is None else wheel_root,
            self.side_slip, self.posture_variances, self.mount_forward, at or self.at,
            self.posture, self.rays,
        )  # fmt: skip
        # What is expected is another now as well.
        _ = step.state
        return step

    def glanced(
        self, slots: NDArray[np.intp], slopes: Array, variances: Array, most: float
    ) -> tuple[Step, Examined]:
        """Linearise where the step seems to have gone at a first glance at its image, and look from there.

        The turn is as the landmarks vote, of whom a quarter may be wrong; the way is left as the wheels say.

        Args:
            slots: (m,) landmarks seen, m > 0.
            slopes: (m, 2) where.
            variances: (2,) of a slope.
            most: sigmas of the wheels by which the guess may be off what they say.

        Returns:
            The step, its covariance computed; and the image beside it.
        """
        before, measured = self.before, self.measured
        turn, posture, rays, by_input, covariance, *examined = kernels.glance(
            before.posture, before.rays, before.covariance, (measured.forward, measured.turn),
            self.mount_forward, self.wheel_root, self.side_slip, self.posture_variances,
            self.rays, slots, slopes, variances, most,
        )  # fmt: skip
        step = Step(
            before, measured, self.wheel_root, self.side_slip, self.posture_variances, self.mount_forward,
            Odometry(measured.forward, turn), posture, rays, MovingState(posture, rays, covariance), by_input,
        )  # fmt: skip
        return step, tuple(examined)

    def in_hindsight(
        self, slots: NDArray[np.intp], residual: Array, whitening: Array
    ) -> tuple[Odometry, float]:
        """What the robot did most likely, as is seen after it, and how many sigmas refute the wheels.

        Args:
            slots: (m,) landmarks seen.
            residual: (m, 2) measured minus expected.
            whitening: (2m, 2m) what whitens the residuals.
        """
        _ = self.state
        forward, turn, surprise = kernels.wheel_errors(
            self._by_input, self.wheel_root, slots, whitening, residual
        )
        return Odometry(self.measured.forward + forward, self.measured.turn + turn), surprise

    def kept(self, mask: NDArray[np.bool_]) -> Step:
        """The step of only some of the landmarks."""
        if mask.all():
            return self
        return replace(self, before=self.before.kept(mask), rays=self.rays[mask], _state=None, _by_input=None)
