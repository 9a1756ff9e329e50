"""The mapping filter's state as a value: what the wheels do to it, and what an image does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.innovations import Examined, examine, measured_entries, turn_by_image, wheel_errors
from mapweave.agent.ekf.motion import move_pose, move_rays, propagate
from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian

PRIOR_DEPTH = 2.5
"""Depth at which a landmark is expected when nothing is known, m."""
PRIOR_SPREAD = 1.2
"""Sigma of the prior inverse depth, in units of 1 / PRIOR_DEPTH: it reaches from 0.3 PRIOR_DEPTH (two
sigma) to infinity (one sigma)."""
LEAST_AGREEING = 3
"""With fewer accepted landmarks than this an update is not healthy."""


@dataclass(frozen=True, eq=False)
class MappingState:
    """Pose since the anchor and landmarks in the moving camera, with their joint covariance.

    Attributes:
        pose_vector: (3,) [x m, y m, heading rad], anchor_from_robot.
        rays: (n, 3) [a, b, w 1/m] in the present camera frame.
        covariance: (3 + 3n, 3 + 3n) of [pose, rays], additive errors.
    """

    pose_vector: Array
    rays: Array
    covariance: Array

    @staticmethod
    def at_anchor() -> MappingState:
        """The state at the anchor with certainty (the paper's P_0^r = 0), without landmarks."""
        return MappingState(np.zeros(3), np.zeros((0, 3)), np.zeros((3, 3)))

    @cached_property
    def pose(self) -> PoseGaussian:
        """`anchor_from_robot`, perturbed on the right as everywhere outside the filter."""
        pose_vector = Pose2.from_vector(self.pose_vector)
        turn = np.eye(3)
        turn[:2, :2] = pose_vector.rotation.T
        return PoseGaussian(pose_vector, turn @ self.covariance[:3, :3] @ turn.T)

    @property
    def blocks(self) -> Array:
        """(n, 3, 3) covariance of each landmark by itself."""
        n = len(self.rays)
        index = np.arange(n)
        blocks: Array = self.covariance[3:, 3:].reshape(n, 3, n, 3)[index, :, index, :]
        return blocks

    def grown(self, rays: Array, variances: Array) -> MappingState:
        """The state with further landmarks, rays and variances (N, 3), independent of all that is there."""
        size, more = len(self.covariance), rays.size
        covariance = np.zeros((size + more, size + more))
        covariance[:size, :size] = self.covariance
        index = np.arange(size, size + more)
        covariance[index, index] = variances.ravel()
        return MappingState(self.pose_vector, np.concatenate([self.rays, rays]), covariance)

    def kept(self, mask: NDArray[np.bool_]) -> MappingState:
        """The state with only some of its landmarks, by a mask (n,)."""
        index = np.concatenate([[0, 1, 2], 3 + np.flatnonzero(np.repeat(mask, 3))])
        return MappingState(self.pose_vector, self.rays[mask], self.covariance[np.ix_(index, index)])

    def reanchored(self) -> MappingState:
        """The state with the present pose as anchor: exact, as landmarks are in the robot's frame."""
        covariance = self.covariance.copy()
        covariance[:3, :] = covariance[:, :3] = 0.0
        return MappingState(np.zeros(3), self.rays, covariance)

    def pitched(self, pitch: float, variance: float) -> MappingState:
        """The state with landmarks as a camera sees them that looks up by so much more: they move down.

        What is wrong about the pitch is wrong about all of them alike; beside that, how uncertain they are
        changes by a share of the pitch only.

        Args:
            pitch: rad.
            variance: of its error, rad^2.
        """
        rays = self.rays.copy()
        rays[:, 1] += pitch
        rays /= 1.0 - pitch * self.rays[:, 1:2]
        by_pitch = self.rays * self.rays[:, 1:2] + [0.0, 1.0, 0.0]
        covariance = self.covariance.copy()
        covariance[3:, 3:] += variance * np.outer(by_pitch, by_pitch)
        return MappingState(self.pose_vector, rays, covariance)

    def corrected(
        self, slots: NDArray[np.intp], residual: Array, whitening: Array
    ) -> tuple[MappingState, float]:
        """Kalman update by direct measurements of the slopes (a, b) of some landmarks.

        With G = W P_M, P_M the rows of P that are measured, the state becomes x + G^T W r and its covariance
        P - G^T G.

        Args:
            slots: (m,) which landmarks, each once.
            residual: (m, 2) r, measured minus expected.
            whitening: (2m, 2m) W of the residuals' covariance (mapweave.agent.ekf.innovations.whiten).

        Returns:
            The state after, its covariance symmetric to the last bit; and r^T S^-1 r.
        """
        root = whitening @ self.covariance[measured_entries(slots)]
        white = whitening @ residual.ravel()
        step = white @ root
        # A product with its own transpose is symmetric to the last bit.
        covariance = self.covariance - root.T @ root
        state = MappingState(self.pose_vector + step[:3], self.rays + step[3:].reshape(-1, 3), covariance)
        return state, float(white @ white)


@dataclass(eq=False, slots=True)
class WheelStep:
    """One step of the wheels, linearised where it seems to have gone, until an image has judged it.

    Attributes:
        before: state before the step.
        measured: by the wheels.
        wheel_root: (2, 2) root of the covariance S of (u1, u2).
        side_slip: sigma of u3, m.
        mount_forward: of the optical centre ahead of the axle, m.
        at: where the step is linearised: as measured, or a better guess.
        pose_vector: (3,) expected after the step.
        rays: (n, 3) expected after the step.
    """

    before: MappingState
    measured: Odometry
    wheel_root: Array
    side_slip: float
    mount_forward: float
    at: Odometry
    pose_vector: Array
    rays: Array
    _after: tuple[MappingState, Array] | None = None

    @property
    def state(self) -> MappingState:
        """After the step: P- = A P A^T + B S B^T (docs/method.md); computed when first asked for."""
        return self._advanced()[0]

    def again(self, at: Odometry | None = None, wheel_root: Array | None = None) -> WheelStep:
        """The same step linearised elsewhere, or with more odometry noise."""
        step = WheelStep(
            self.before, self.measured, self.wheel_root if wheel_root is None else wheel_root,
            self.side_slip, self.mount_forward, at or self.at,
            self.pose_vector, self.rays,
        )  # fmt: skip
        # What is expected is another now as well.
        _ = step.state
        return step

    def linearised_by_image(
        self, slots: NDArray[np.intp], slopes: Array, variances: Array, most: float
    ) -> tuple[WheelStep, Examined]:
        """Linearise at the turn that the image suggests, and compare the image with that prediction.

        The turn comes from the landmarks, of which a quarter may be wrong; the way comes from the wheels.

        Args:
            slots: (m,) landmarks seen, m > 0.
            slopes: (m, 2) where.
            variances: (2,) of a slope.
            most: largest deviation of the turn from the wheels, in their sigmas.

        Returns:
            The step, its covariance computed; and the image compared with it.
        """
        more = turn_by_image(self.rays, slots, slopes, self.wheel_root, most)
        step = self.again(at=Odometry(self.measured.forward, self.measured.turn + more))
        return step, examine(step.state.rays, step.state.covariance, slots, slopes, variances)

    def in_hindsight(
        self, slots: NDArray[np.intp], residual: Array, whitening: Array
    ) -> tuple[Odometry, float]:
        """What the robot did most likely, as is seen after it, and how many sigmas refute the wheels.

        Args:
            slots: (m,) landmarks seen.
            residual: (m, 2) measured minus expected.
            whitening: (2m, 2m) what whitens the residuals.
        """
        by_input = self._advanced()[1]
        forward, turn, surprise = wheel_errors(by_input, self.wheel_root, slots, whitening, residual)
        return Odometry(self.measured.forward + forward, self.measured.turn + turn), surprise

    def kept(self, mask: NDArray[np.bool_]) -> WheelStep:
        """The step of only some of the landmarks, by a mask (n,)."""
        if mask.all():
            return self
        return replace(self, before=self.before.kept(mask), rays=self.rays[mask], _after=None)

    def _advanced(self) -> tuple[MappingState, Array]:
        """The state after the step, and the Jacobian of its mean by (u1, u2, u3), (3 + 3n, 3).

        The mean is exact where the step is linearised, and of first order elsewhere.
        """
        if self._after is not None:
            return self._after
        before, at = self.before, self.at
        pose_vector, by_pose, pose_by_input = move_pose(before.pose_vector, at)
        moved = move_rays(before.rays, at, self.mount_forward)
        by_state = np.concatenate([by_pose[None], moved.by_ray])
        by_input = np.concatenate([pose_by_input, moved.by_input.reshape(-1, 3)])
        input_root = np.zeros((3, 3))
        input_root[:2, :2], input_root[2, 2] = self.wheel_root, self.side_slip
        covariance = propagate(before.covariance, by_state, by_input, input_root)
        further = np.array([self.measured.forward - at.forward, self.measured.turn - at.turn])
        shift = by_input[:, :2] @ further
        self.pose_vector, self.rays = pose_vector + shift[:3], moved.rays + shift[3:].reshape(-1, 3)
        self._after = MappingState(self.pose_vector, self.rays, covariance), by_input
        return self._after
