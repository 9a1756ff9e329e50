"""The best posture near a first one, by iterated Gauss-Newton, and how certain it is.

The points may move within their own uncertainty. They are variables that are eliminated in closed form: each
round linearises at the points' present estimates, the residual refers back to where they were given, and
their covariance is part of the residual's (the iterated extended Kalman filter's form of a Schur complement).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.pose import Array, Pose2, PoseGaussian
from hybridmap.recognising.kernels import kernels
from hybridmap.recognising.sightings import DEPTH_DECADES, GATES, NEAREST, NO_DEPTH_SIGMA, Sightings

SMALL_STEP = 1e-4
"""Gauss-Newton ends when no component moves more, m and rad: far below any posture's uncertainty."""


@dataclass(frozen=True, eq=False)
class PlanarFix:
    """A posture from sightings.

    Attributes:
        node_from_robot: posture of the robot in the points' frame.
        inliers: (N,) which sightings agree with it.
        mean_square: mean squared normalised residual of the inliers; 1 when the uncertainties are right.
        rms_px: of the inliers' residuals, px, after the points moved within their uncertainty.
        log_evidence: sum over the inliers of how much likelier they are than wrong matches, nats.
        rival: what the mirrored posture explains (see mirror.py), as a share of what this one does; 0 if
            there is no other.
    """

    node_from_robot: PoseGaussian
    inliers: NDArray[np.bool_]
    mean_square: float
    rms_px: float
    log_evidence: float
    rival: float = 0.0


@dataclass(frozen=True, eq=False)
class Stack:
    """All sightings of one problem, in columns; each row has its own camera and direction.

    Attributes:
        points: (N, 3) m.
        covariances: (N, 3, 3) m^2.
        observed: (N, 3) u px, v px, depth m; the depth is NaN where not measured.
        noise: (N, 3) variances of these.
        measured: (N,) where the depth is.
        gates: (N,) largest squared normalised residual of an inlier.
        log_wrong: (N,) what -log of a right match's density is compared with, nats.
        inverted: (N,) see Sightings.
        optics: (6, N) fx, fy, cx, cy px, mount_height, mount_forward m.
    """

    points: Array
    covariances: Array
    observed: Array
    noise: Array
    measured: NDArray[np.bool_]
    gates: Array
    log_wrong: Array
    inverted: NDArray[np.bool_]
    optics: Array

    @staticmethod
    def build(parts: Sequence[Sightings]) -> Stack:
        """Put sightings one after the other."""
        measured = np.concatenate([part.depth_measured for part in parts])
        depths = np.concatenate([part.depths for part in parts])
        sigmas = np.concatenate([part.depth_sigmas for part in parts])
        counts = [len(part) for part in parts]
        pixel = np.repeat([part.pixel_sigma**2 for part in parts], counts)
        cameras = [part.camera for part in parts]
        optics = [(c.fx, c.fy, c.cx, c.cy, c.mount_height, c.mount_forward) for c in cameras]
        log_area = np.repeat([math.log(c.width * c.height / (2 * math.pi)) for c in cameras], counts)
        log_depth = np.log(DEPTH_DECADES * np.where(measured, depths, 1.0)) - 0.5 * math.log(2 * math.pi)
        return Stack(
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.covariances for part in parts]),
            np.column_stack(
                [np.concatenate([part.pixels for part in parts]), np.where(measured, depths, np.nan)]
            ),
            np.column_stack([pixel, pixel, np.where(measured, sigmas, NO_DEPTH_SIGMA) ** 2]),
            measured,
            np.where(measured, GATES[1], GATES[0]),
            log_area + np.where(measured, log_depth, math.log(NO_DEPTH_SIGMA)),
            np.repeat([part.inverted for part in parts], counts),
            np.ascontiguousarray(np.repeat(np.array(optics, dtype=np.float64).T, counts, axis=1)),
        )

    def predict(self, wanted: Pose2, points: Array) -> tuple[Array, Array, Array]:
        """Predict each sighting and how it changes.

        Args:
            wanted: posture.
            points: (N, 3) m, where to linearise.

        Returns:
            predicted (N, 3): u px, v px, depth m. By the posture (N, 3, 3), perturbed on the right as in
            PoseGaussian. By the point (N, 3, 3). Points behind the camera give NaN.
        """
        predicted, by_pose, by_point = kernels().predict(
            np.ascontiguousarray(points, dtype=np.float64), self.inverted, self.optics, wanted.vector, NEAREST
        )
        return predicted, by_pose, by_point

    @property
    def columns(self) -> tuple[NDArray[Any], ...]:
        """As machine code takes them."""
        return (
            self.points, self.covariances, self.observed, self.noise, self.measured, self.gates,
            self.log_wrong, self.inverted, self.optics,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Linear:
    """The problem linearised at a posture and at points.

    Attributes:
        residuals: (N, 3) px, px, m, against the points where they were given.
        reprojection_px: (N, 2) against the points where they are now.
        by_pose: (N, 3, 3), of the prediction by the wanted posture.
        by_point: (N, 3, 3), of the prediction by the point.
        information: (N, 3, 3), inverse covariance of the residuals.
        distance2: (N,) squared normalised residuals.
        log_ratios: (N,) nats against a wrong match, not cut.
        inliers: (N,).
        weights: (N,) probability that a sighting is right, 0 of those that are no inliers.
    """

    residuals: Array
    reprojection_px: Array
    by_pose: Array
    by_point: Array
    information: Array
    distance2: Array
    log_ratios: Array
    inliers: NDArray[np.bool_]
    weights: Array

    @property
    def weighted(self) -> Array:
        """(3, 3N) derivative times information times weight."""
        return (self.information @ self.by_pose * self.weights[:, None, None]).reshape(-1, 3).T


def _linearise(stack: Stack, wanted: Pose2, points: Array) -> _Linear:
    return _Linear(*kernels().linearise(*stack.columns, wanted.vector, points, NEAREST))


def improve(stack: Stack, pose: Pose2, prior: PoseGaussian | None, rounds: int) -> tuple[Pose2, Array] | None:
    """Bring a posture to its best.

    Args:
        stack: the sightings.
        pose: where to start.
        prior: what else is known of the posture.
        rounds: of Gauss-Newton at most.

    Returns:
        The posture and the points (N, 3) m at their best for it; None if the inliers do not determine a
        posture.
    """
    mean, information = _told(prior)
    determined, vector, moved = kernels().improve(
        *stack.columns, pose.vector, mean, information, rounds, NEAREST, SMALL_STEP
    )
    return (Pose2.from_vector(vector), moved) if determined else None


def refine(
    stack: Stack,
    pose: Pose2,
    scale_sigma: float,
    prior: PoseGaussian | None,
    rounds: int,
    shift_sigma: float = 0.0,
) -> PlanarFix | None:
    """Bring a posture to its best and say how certain it is.

    The covariance is the inverse information, larger where the residuals are larger than they should be,
    and larger by what does not average out: a common scale error of the points, or of the measured depths,
    which come from one drive with one set of wheels, and a shift of all pixels.

    Args:
        stack: the sightings.
        pose: where to start.
        scale_sigma: share by which all points, or all measured depths, may be wrong together.
        prior: what else is known of the posture.
        rounds: of Gauss-Newton at most.
        shift_sigma: px by which all pixels may be off together, to either side.

    Returns:
        The posture, or None if the inliers do not determine one.
    """
    improved = improve(stack, pose, prior, rounds)
    if improved is None:
        return None
    pose, moved = improved
    linear = _linearise(stack, pose, moved)
    information, _ = kernels().normal_equations(
        linear.residuals, linear.by_pose, linear.information, linear.weights
    )
    information += _told(prior)[1]
    inliers = linear.inliers
    if not inliers.any() or not kernels().determined(information):
        return None
    covariance = np.linalg.inv(information)
    freedom = max(int(np.where(stack.measured, 3, 2)[inliers].sum()) - 3, 1)
    mean_square = float(linear.distance2[inliers].sum()) / freedom
    alone = covariance = covariance * max(1.0, mean_square)
    common = [scale_sigma * share for share in _common_scales(stack, linear, moved)]
    common += [shift_sigma * np.tile(side, (len(moved), 1)) for side in np.eye(3)[:2]]
    for change in common:
        drift = alone @ (linear.weighted @ change.ravel())
        covariance = covariance + np.outer(drift, drift)
    return PlanarFix(
        PoseGaussian(pose, 0.5 * (covariance + covariance.T)),
        inliers,
        mean_square,
        float(np.sqrt((linear.reprojection_px[inliers] ** 2).sum(axis=1).mean())),
        float(linear.log_ratios[inliers].sum()),
    )


def _common_scales(stack: Stack, linear: _Linear, points: Array) -> list[Array]:
    """How the residuals (N, 3) change when all points, or all depths, of one side grow together.

    One side's points are the forward rows' points and the inverted rows' depths; the other's the reverse.
    """
    by_points = -(linear.by_point @ points[:, :, None])[:, :, 0]
    by_points[~stack.measured, 2] = 0.0
    by_depths = np.zeros_like(by_points)
    by_depths[:, 2] = np.where(stack.measured, stack.observed[:, 2], 0.0)
    inverted = stack.inverted[:, None]
    return [np.where(inverted, by_depths, by_points), np.where(inverted, by_points, by_depths)]


def _told(prior: PoseGaussian | None) -> tuple[Array, Array]:
    """(3,) mean and (3, 3) information of what else is known."""
    if prior is None:
        return np.zeros(3), np.zeros((3, 3))
    information = np.linalg.inv(prior.covariance + 1e-12 * np.eye(3)).astype(np.float64, copy=False)
    return prior.mean.vector, information
