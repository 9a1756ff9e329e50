"""The best pose near a first one, by iterated Gauss-Newton, and how certain it is.

A pitch of the camera is one more variable, with a prior; what is said of the pose holds whatever it is.
The points may move within their own uncertainty. They are variables that are eliminated in closed form: each
round linearises at the points' present estimates, the residual refers back to where they were given, and
their covariance is part of the residual's (the iterated extended Kalman filter's form of a Schur complement).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.registration import projection
from mapweave.registration.projection import (
    DEPTH_DECADES,
    GATE,
    Linear,
    Stack,
    determined,
    linearise,
    normal_equations,
    of_pose_alone,
)
from mapweave.registration.sightings import Sightings

GAUSS_NEWTON_STEPS = 20
"""Gauss-Newton steps, at most. From a good start it takes four or five, from a mirrored pose a dozen: what is
still on its way is no optimum."""

DEPTH_GATE = 11.34
"""Chi-square 99 % point for 3 degrees of freedom."""

NO_DEPTH_SIGMA = 1e3
"""Marks "depth not measured", m."""


@dataclass(frozen=True, eq=False)
class PlanarFix:
    """A pose from sightings.

    Attributes:
        node_from_robot: pose of the robot in the points' frame.
        inliers: (N,) which sightings agree with it.
        mean_square: mean squared normalised residual of the inliers; 1 when the uncertainties are right.
        rms_px: of the inliers' residuals, px, after the points moved within their uncertainty.
        log_evidence: sum over the inliers of how much likelier they are than wrong matches, nats; with
            the pitch's prior, and marginalised over it.
        rival: what the mirrored pose explains (see planar_ambiguity.py), as a share of what this one does; 0
            if there is no other.
        rival_distance: how far away that pose is, m.
        pitch: by which the camera looks up against the points' frame, rad.
        spread: (3, 3) part of the covariance by which the mirrored pose, too, may be the true one.
    """

    node_from_robot: PoseGaussian
    inliers: NDArray[np.bool_]
    mean_square: float
    rms_px: float
    log_evidence: float
    rival: float = 0.0
    rival_distance: float = 0.0
    pitch: float = 0.0
    spread: Array = field(default_factory=lambda: np.zeros((3, 3)))


def stack_sightings(parts: Sequence[Sightings], pitch_sigma: float = 0.0) -> Stack:
    """Concatenate the sightings of one problem, with the prior of its pitch, rad."""
    measured = np.concatenate([part.depth_measured for part in parts])
    depths = np.where(measured, np.concatenate([part.depths for part in parts]), 0.0)
    sigmas = np.where(measured, np.concatenate([part.depth_sigmas for part in parts]), NO_DEPTH_SIGMA)
    counts = [len(part) for part in parts]
    pixel = np.repeat([part.pixel_sigma**2 for part in parts], counts)
    cameras = [part.camera for part in parts]
    optics = [(c.fx, c.fy, c.cx, c.cy, c.mount_height, c.mount_forward) for c in cameras]
    log_area = np.repeat([math.log(c.width * c.height / (2 * math.pi)) for c in cameras], counts)
    log_depth = np.log(DEPTH_DECADES * np.where(measured, depths, 1.0)) - 0.5 * math.log(2 * math.pi)
    return Stack(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.column_stack([np.concatenate([part.pixels for part in parts]), depths]),
        np.column_stack([pixel, pixel, sigmas**2]),
        measured,
        np.where(measured, DEPTH_GATE, GATE),
        log_area + np.where(measured, log_depth, math.log(NO_DEPTH_SIGMA)),
        np.repeat([part.inverted for part in parts], counts),
        np.repeat(np.array(optics, np.float64), counts, axis=0),
        float(pitch_sigma),
    )


def improve(stack: Stack, start: Array, rounds: int) -> tuple[Array, Array] | None:
    """Bring a pose to its best.

    Args:
        stack: the sightings.
        start: (4,) pose m, m, rad, and pitch in sigmas.
        rounds: of Gauss-Newton at most.

    Returns:
        Pose and pitch (4,) and the points (N, 3) m at their best for them; None if the inliers do not
        determine a pose.
    """
    sure, state, points = projection.improve(stack, start, rounds)
    return (state, points) if sure else None


def refine(stack: Stack, start: Array, scale_sigma: float, shift_sigma: float = 0.0) -> PlanarFix | None:
    """Refine a pose and compute its covariance.

    The covariance is the inverse information, larger where the residuals are larger than they should be,
    and larger by what does not average out: a common scale error of the points, or of the measured depths,
    which come from one drive with one set of wheels, and a shift of all pixels. The pitch is marginalised
    out.

    Args:
        stack: the sightings.
        start: (4,) pose m, m, rad, and pitch in sigmas.
        scale_sigma: share by which all points, or all measured depths, may be wrong together.
        shift_sigma: px by which all pixels may be off together, to either side.

    Returns:
        The pose, or None if the inliers do not determine one.
    """
    solution = _solution(stack, start)
    if solution is None:
        return None
    state, moved, linear, products, covariance = solution
    inliers = linear.inliers
    freedom = max(int(np.where(stack.measured, 3, 2)[inliers].sum()) - 3, 1)
    mean_square = float(linear.distance2[inliers].sum()) / freedom
    alone = covariance = covariance * max(1.0, mean_square)
    common = [scale_sigma * share for share in _common_scales(stack, linear, moved)]
    if shift_sigma:
        common += [shift_sigma * np.tile(side, (len(moved), 1)) for side in np.eye(3)[:2]]
    covariance = covariance[:, :3]
    for change in common:
        drift = alone @ _gradient(linear, change)
        covariance = covariance + np.outer(drift, drift)
    return PlanarFix(
        PoseGaussian(Pose2.from_vector(state[:3]), 0.5 * (covariance + covariance.T)),
        inliers,
        mean_square,
        float(np.sqrt((linear.reprojection_px[inliers] ** 2).sum(axis=1).mean())),
        float(linear.log_ratios[inliers].sum()) - 0.5 * float(state[3] ** 2 + np.log(products[4, 4])),
        pitch=float(stack.pitch_sigma * state[3]),
    )


def by_scales(stack: Stack, start: Array) -> Array | None:
    """How a pose changes with the natural logarithms of the scales of the lengths of its two sides.

    Args:
        stack: its sightings.
        start: (4,) pose m, m, rad, and pitch in sigmas.

    Returns:
        (3, 2) right perturbation of the pose, m, m, rad; of the forward points' side first. None if the
        inliers do not determine a pose.
    """
    solution = _solution(stack, start)
    if solution is None:
        return None
    _, moved, linear, _, covariance = solution
    changes = [covariance @ _gradient(linear, change) for change in _common_scales(stack, linear, moved)]
    return np.stack(changes, axis=1)


def _solution(stack: Stack, start: Array) -> tuple[Array, Array, Linear, Array, Array] | None:
    """Bring a pose to its best; None if its inliers do not determine one.

    Returns:
        (4,) state and moved points as of `improve`, linearised there, normal equations, and (3, 4) covariance
        of the pose, with itself and with the pitch.
    """
    improved = improve(stack, start, GAUSS_NEWTON_STEPS)
    if improved is None:
        return None
    state, moved = improved
    linear = linearise(stack, state, moved)
    products = normal_equations(linear, state[3])
    if not linear.inliers.any() or not determined(of_pose_alone(products)):
        return None
    covariance = np.asarray(np.linalg.inv(products[1:, 1:])[:3], np.float64)
    return state, moved, linear, products, covariance


def _common_scales(stack: Stack, linear: Linear, points: Array) -> list[Array]:
    """How the residuals (N, 3) change when all points, or all depths, of one side grow together.

    One side's points are the forward rows' points and the inverted rows' depths; the other's the reverse.
    """
    (u_x, u_y, v_x, v_z), (c, s) = linear.by_point.T, linear.axes.T
    forward, left = c * points[:, 0] + s * points[:, 1], c * points[:, 1] - s * points[:, 0]
    by_points = -np.stack([u_x * forward + u_y * left, v_x * forward + v_z * points[:, 2], forward], axis=1)
    by_points[~stack.measured, 2] = 0.0
    by_depths = np.zeros_like(by_points)
    by_depths[:, 2] = stack.observed[:, 2]
    inverted = stack.inverted[:, None]
    return [np.where(inverted, by_depths, by_points), np.where(inverted, by_points, by_depths)]


def _gradient(linear: Linear, residuals: Array) -> Array:
    """(4,) gradient of pose and pitch by other residuals (N, 3), with the same weights."""
    f00, f10, f11, f20, f21, f22 = linear.factor.T
    white = np.empty_like(residuals)
    white[:, 0] = residuals[:, 0] / f00
    white[:, 1] = (residuals[:, 1] - f10 * white[:, 0]) / f11
    white[:, 2] = (residuals[:, 2] - f20 * white[:, 0] - f21 * white[:, 1]) / f22
    white *= linear.weights[:, None]
    return np.asarray(white.ravel() @ linear.white[:, :, 1:].reshape(-1, 4), np.float64)
