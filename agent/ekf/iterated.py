"""The iterated update: linearise again where the first linearisation did not hold."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.gating import select_inliers
from mapweave.agent.ekf.innovations import whiten
from mapweave.agent.ekf.inverse_depth import project_anchored
from mapweave.agent.ekf.localization_state import NEAREST_SCALE, LocalizationState
from mapweave.hybridmap.pose import Array


@dataclass(frozen=True, eq=False)
class LandmarkMeasurements:
    """An image's measurements of some landmarks.

    Attributes:
        slots: (N,) their places in the state.
        slopes: (N, 2) where they are seen, (pixel - principal point) / focal length.
        variances: (2,) of a slope.
        gate: chi-square threshold.
        most: linearisations at most.
        linear: a slope whose second-order part stays below this needs no further linearisation.
    """

    slots: NDArray[np.intp]
    slopes: Array
    variances: Array
    gate: float
    most: int
    linear: float


@dataclass(frozen=True, eq=False)
class IteratedUpdate:
    """The result of an iterated EKF update.

    Attributes:
        state: after the update.
        accepted: (N,) measurements that were accepted.
        innovations: (N, 2) slopes, measured minus expected, at the first linearisation.
        mean_nis: normalised innovation squared over its degrees of freedom; NaN if none was accepted.
    """

    state: LocalizationState
    accepted: NDArray[np.bool_]
    innovations: Array
    mean_nis: float


def iterated_update(
    state: LocalizationState, start: Array, measured: LandmarkMeasurements, mount_forward: float
) -> IteratedUpdate | None:
    """Correct the state by an image (iterated extended Kalman filter: Gauss-Newton on the MAP cost).

    Args:
        state: before the update: prior mean and covariance.
        start: (3,) pose at which to linearise first, the prior's or a better one.
        measured: the image.
        mount_forward: of the optical centre ahead of the axle, m.

    Returns:
        The correction, or None if an iterate had a landmark behind the camera: the prior is too uncertain.
    """
    n, slots = len(measured.slots), measured.slots
    index = (3 + 3 * slots[:, None] + np.arange(3)).ravel()
    pose_vector, rays = start, state.rays
    first: Array | None = None
    accepted: NDArray[np.bool_] = np.ones(n, np.bool_)
    for _ in range(measured.most):
        projected = project_anchored(pose_vector, rays[slots], mount_forward)
        first_projected = project_anchored(pose_vector, state.first[slots], mount_forward)
        if (np.minimum(projected.scale, first_projected.scale) <= NEAREST_SCALE).any():
            return None
        by_pose = first_projected.by_pose[:, :2].reshape(2 * n, 3)
        by_ray = first_projected.by_ray[:, :2]
        rows = by_pose @ state.covariance[:3]
        rows += (by_ray @ state.covariance[index].reshape(n, 3, -1)).reshape(2 * n, -1)
        columns = rows.T
        spread = by_pose @ columns[:3] + (by_ray @ columns[index].reshape(n, 3, -1)).reshape(2 * n, 2 * n)
        spread[np.arange(2 * n), np.arange(2 * n)] += np.tile(measured.variances, n)
        # The prior mean as seen from this linearisation point.
        back = _linear(by_pose, by_ray, state.pose_vector - pose_vector, (state.rays - rays)[slots])
        innovations = measured.slopes - projected.rays[:, :2] - back
        if first is None:
            first = innovations
            accepted, whitening, _ = select_inliers(innovations, spread, measured.gate)
            if not accepted.any():
                return IteratedUpdate(state, accepted, first, float("nan"))
        else:
            both = np.flatnonzero(np.repeat(accepted, 2))
            whitening = whiten(spread[np.ix_(both, both)])
        root = columns[:, np.repeat(accepted, 2)] @ whitening.T
        white = whitening @ innovations[accepted].ravel()
        step = root @ white
        new_pose, new_rays = state.stepped(step)
        change = _linear(by_pose, by_ray, new_pose - pose_vector, (new_rays - rays)[slots])
        promised = projected.rays[:, :2] + change
        pose_vector, rays = new_pose, new_rays
        kept = project_anchored(pose_vector, rays[slots], mount_forward).rays[:, :2]
        if np.abs(kept - promised)[accepted].max() < measured.linear:
            break
    corrected = state.corrected(step, root)
    nis = float(white @ white) / len(white)
    assert first is not None
    return IteratedUpdate(corrected, accepted, first, nis)


def _linear(by_pose: Array, by_ray: Array, pose_vector: Array, rays: Array) -> Array:
    """(N, 2) change of the slopes to first order, for changes of pose (3,) and rays (N, 3)."""
    return (by_pose @ pose_vector).reshape(-1, 2) + (by_ray @ rays[:, :, None])[:, :, 0]
