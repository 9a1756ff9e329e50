"""The best posture near a first one, by iterated Gauss-Newton, and how certain it is.

The points may move within their own uncertainty. They are variables that are eliminated in closed form: each
round linearises at the points' present estimates, the residual refers back to where they were given, and
their covariance is part of the residual's (the iterated extended Kalman filter's form of a Schur complement).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.pose import Array, Pose2, PoseGaussian
from hybridmap.sightings import DEPTH_DECADES, GATES, NO_DEPTH_SIGMA, Sightings

SMALL_STEP = 1e-5
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
    """

    node_from_robot: PoseGaussian
    inliers: NDArray[np.bool_]
    mean_square: float
    rms_px: float
    log_evidence: float


@dataclass(frozen=True, eq=False)
class Block:
    """Sightings of one image, in the direction asked for or the other way round.

    Attributes:
        sightings: of points.
        inverted: the points are in the robot's frame and the image was taken at the origin of the wanted
            posture's frame.
    """

    sightings: Sightings
    inverted: bool = False


@dataclass(frozen=True, eq=False)
class Linear:
    """One block linearised: what Gauss-Newton needs.

    Attributes:
        residuals: (N, 3) px, px, m, against the points where they were given.
        reprojection_px: (N, 2) against the points where they are now.
        by_pose: (N, 3, 3), of the prediction by the wanted posture.
        by_scale: (N, 3, 2), of the residual by the common scale of the points and of the measured depths.
        information: (N, 3, 3), inverse covariance of the residuals.
        gain: (N, 3, 3), from residual to point.
        distance2: (N,) squared normalised residuals.
        log_ratios: (N,) nats against a wrong match, not cut.
        inliers: (N,).
    """

    residuals: Array
    reprojection_px: Array
    by_pose: Array
    by_scale: Array
    information: Array
    gain: Array
    distance2: Array
    log_ratios: Array
    inliers: NDArray[np.bool_]


def _linearise(block: Block, wanted: Pose2, points: Array) -> Linear:
    sightings = block.sightings
    pose = wanted.inverse() if block.inverted else wanted
    predicted, by_pose, by_point = sightings.linearise(pose, points)
    measured = sightings.depth_measured
    observed = np.column_stack([sightings.pixels, np.where(measured, sightings.depths, predicted[:, 2])])
    reprojection_px = (observed - predicted)[:, :2]
    residuals = observed - predicted - np.einsum("nij,nj->ni", by_point, sightings.points - points)
    visible = np.isfinite(predicted).all(axis=1) & np.isfinite(residuals).all(axis=1)
    by_point = np.where(visible[:, None, None], by_point, 0.0)
    by_pose = np.where(visible[:, None, None], by_pose, 0.0)
    residuals = np.where(visible[:, None], residuals, 0.0)
    residuals[~measured, 2] = 0.0

    to_point = sightings.covariances @ by_point.transpose(0, 2, 1)
    spread = by_point @ to_point
    spread[:, 0, 0] += sightings.pixel_sigma**2
    spread[:, 1, 1] += sightings.pixel_sigma**2
    spread[:, 2, 2] += np.where(measured, sightings.depth_sigmas, NO_DEPTH_SIGMA) ** 2
    information = np.linalg.inv(spread).astype(np.float64, copy=False)
    distance2 = np.einsum("ni,nij,nj->n", residuals, information, residuals)
    area = float(sightings.camera.width * sightings.camera.height)
    depth_terms = np.where(
        measured,
        np.log(DEPTH_DECADES * np.where(measured, sightings.depths, 1.0)) - 0.5 * math.log(2 * math.pi),
        math.log(NO_DEPTH_SIGMA),
    )
    log_ratios = math.log(area / (2 * math.pi)) + depth_terms - 0.5 * np.log(np.linalg.det(spread))
    log_ratios -= 0.5 * distance2
    gates = np.where(measured, GATES[1], GATES[0])
    by_scale = np.zeros((len(points), 3, 2))
    by_scale[:, :, 0] = -np.einsum("nij,nj->ni", by_point, points)
    by_scale[:, 2, 1] = np.where(measured, sightings.depths, 0.0)
    if block.inverted:
        # inverse(wanted @ d) = inverse(wanted) @ (-Ad(wanted) d) to first order.
        by_pose = by_pose @ -wanted.adjoint
    return Linear(
        residuals,
        reprojection_px,
        by_pose,
        by_scale,
        information,
        to_point @ information,
        distance2,
        log_ratios,
        visible & (distance2 < gates) & (log_ratios > 0),
    )


def improve(
    blocks: Sequence[Block], pose: Pose2, prior: PoseGaussian | None, rounds: int
) -> tuple[Pose2, list[Array]] | None:
    """Bring a posture to its best.

    Args:
        blocks: the sightings.
        pose: where to start.
        prior: what else is known of the posture.
        rounds: of Gauss-Newton at most.

    Returns:
        The posture and each block's points (N, 3) m at their best for it; None if the inliers do not
        determine a posture.
    """
    moved = [block.sightings.points for block in blocks]
    for _ in range(rounds):
        linear = [_linearise(block, pose, points) for block, points in zip(blocks, moved, strict=True)]
        information, gradient, _ = _normal_equations(linear, pose, prior)
        step = _solve(information, gradient)
        if step is None:
            return None
        pose = pose @ Pose2.from_vector(step)
        moved = [_move(block, part, step) for block, part in zip(blocks, linear, strict=True)]
        if np.abs(step).max() < SMALL_STEP:
            break
    return pose, moved


def refine(
    blocks: Sequence[Block],
    pose: Pose2,
    scale_sigma: float,
    prior: PoseGaussian | None,
    rounds: int,
) -> PlanarFix | None:
    """Bring a posture to its best and say how certain it is.

    Args:
        blocks: the sightings.
        pose: where to start.
        scale_sigma: share by which all points, or all measured depths, of a block may be wrong together.
        prior: what else is known of the posture.
        rounds: of Gauss-Newton at most.

    Returns:
        The posture, or None if the inliers do not determine one.
    """
    improved = improve(blocks, pose, prior, rounds)
    if improved is None:
        return None
    pose, moved = improved
    linear = [_linearise(block, pose, points) for block, points in zip(blocks, moved, strict=True)]
    information, _, common = _normal_equations(linear, pose, prior)
    inliers = np.concatenate([part.inliers for part in linear])
    covariance = _solve(information, np.eye(3))
    if covariance is None or not inliers.any():
        return None
    measured = np.concatenate([block.sightings.depth_measured for block in blocks])
    distance2 = np.concatenate([part.distance2 for part in linear])
    freedom = max(int(np.where(measured, 3, 2)[inliers].sum()) - 3, 1)
    mean_square = float(distance2[inliers].sum()) / freedom
    covariance = covariance * max(1.0, mean_square)
    drifts = scale_sigma * np.concatenate(common) @ covariance
    covariance = covariance + drifts.T @ drifts
    pixels = np.concatenate([part.reprojection_px for part in linear])[inliers]
    return PlanarFix(
        PoseGaussian(pose, 0.5 * (covariance + covariance.T)),
        inliers,
        mean_square,
        float(np.sqrt((pixels**2).sum(axis=1).mean())),
        float(np.concatenate([part.log_ratios for part in linear])[inliers].sum()),
    )


def _normal_equations(
    linear: Sequence[Linear], pose: Pose2, prior: PoseGaussian | None
) -> tuple[Array, Array, list[Array]]:
    """Information (3, 3), gradient (3,), and the gradients (2 per block, 3) that common scales cause."""
    information, gradient, common = np.zeros((3, 3)), np.zeros(3), []
    for part in linear:
        # Each sighting counts by the probability that it is right.
        weights = np.where(part.inliers, 1.0 / (1.0 + np.exp(-np.clip(part.log_ratios, -30, 30))), 0.0)
        weighted = np.einsum("n,nji,njk->nik", weights, part.by_pose, part.information)
        information += np.einsum("nij,njk->ik", weighted, part.by_pose)
        gradient += np.einsum("nij,nj->i", weighted, part.residuals)
        common += [np.einsum("nij,njk->ki", weighted, part.by_scale)]
    if prior is not None:
        weight = np.linalg.inv(prior.covariance + 1e-12 * np.eye(3))
        information += weight
        gradient += weight @ (pose.inverse() @ prior.mean).vector
    return information, gradient, common


def _move(block: Block, part: Linear, step: Array) -> Array:
    """(N, 3) m, the inliers' points at their best for this round; the others where they were given."""
    left = part.residuals - part.by_pose @ step
    moved = block.sightings.points + np.einsum("nij,nj->ni", part.gain, left)
    return np.where(part.inliers[:, None], moved, block.sightings.points)


def _solve(information: Array, right: Array) -> Array | None:
    """Solve unless the information is next to singular; lengths and angles count alike at about 1 m."""
    values = np.linalg.eigvalsh(information)
    if not np.isfinite(values).all() or values[0] <= 1e-9 * max(values[-1], 1e-300):
        return None
    return np.linalg.solve(information, right).astype(np.float64, copy=False)
