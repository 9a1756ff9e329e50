"""How far a mapping run's estimates were from the truth, and whether they knew."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.mapping_run.scene import MappingDrive, RunTick
from mapweave.agent.ekf.inverse_depth import rays_of_points
from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.agent.ekf.mapping_filter import CONVERGED_SHARE, CONVERGED_SIGMA
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle

NEAR, FAR = 0.1, 0.4
"""A robot is back at the anchor within this, and far from it beyond that, m."""
WITHIN = 7.815
"""95 % of chi-square with three degrees of freedom."""

Figures = dict[str, float | None]


def figures(run: MappingDrive) -> Figures:
    """All figures of a run; None where there is nothing to measure."""
    last = run.moments[-1]
    believed = [m.pose.mean for m in run.moments]
    wheels = [m.wheels for m in run.moments]
    steps = [m.step_ms for m in run.moments[1:]]
    away = [math.hypot(m.true.x, m.true.y) for m in run.moments]
    measured = {
        "seconds": float(run.seconds[-1]),
        "way_m": sum(math.hypot(*(m.odometry.motion().vector[:2])) for m in run.moments),
        "reach_m": max(away),
        **_pose_figures("pose", believed, run),
        **_pose_figures("wheels", wheels, run),
        "nees_pose": last.pose.mahalanobis2(last.true),
        **_landmark_figures(run),
        **_track_figures(run, np.array(away)),
        "disbelieved_images": float(sum(not m.believed for m in run.moments)),
        "person_in_view_s": run.robot.tick * sum(not math.isnan(m.person) for m in run.moments),
        "step_ms": float(np.median(steps)) if steps else math.nan,
        "step_ms_p99": float(np.percentile(steps, 99)) if steps else math.nan,
    }
    return {key: float(value) if math.isfinite(value) else None for key, value in measured.items()}


def landmark_nees(estimates: LandmarkEstimates, points_in_robot: Array, camera: Camera) -> Array:
    """(N,) squared Mahalanobis distance of each landmark from its true place, 3 degrees of freedom.

    In the filter's own coordinates, slopes and inverse depth, in which the errors are nearly Gaussian; a
    landmark that may as well be at infinity has none: NaN.
    """
    mount = camera.mount_forward, camera.mount_height
    believed, by_point = rays_of_points(estimates.points_in_robot, *mount)
    true, _ = rays_of_points(points_in_robot, *mount)
    off = believed - true
    known = np.isfinite(off).all(axis=1)
    out = np.full(len(off), np.nan)
    jacobians = by_point[known]
    # The covariance in metres came from that of the rays by the inverse of this very Jacobian.
    rays = jacobians @ estimates.covariances_in_robot[known] @ np.swapaxes(jacobians, 1, 2)
    out[known] = np.einsum("ni,nij,nj->n", off[known], np.linalg.inv(rays), off[known])
    return out


def track_errors(run: MappingDrive, moment: RunTick) -> Array:
    """(N, 2) px, tracks less where their points truly are; NaN for those that are no points."""
    points, flat = run.truth(moment.ids)
    off = moment.pixels - run.robot.camera.project(moment.true.inverse().apply(points))
    off[~flat] = np.nan
    return off


def reprojection_errors(run: MappingDrive, moment: RunTick) -> Array:
    """(N, 2) px, tracks that are landmarks less where the filter then has these."""
    known = moment.landmarks
    _, tracks, held = np.intersect1d(moment.ids, known.ids, return_indices=True)
    return moment.pixels[tracks] - run.robot.camera.project(known.points_in_robot[held])


@dataclass(frozen=True, eq=False)
class LastKnown:
    """Each landmark that the filter began with, as it knew it last: lost ones are not left out.

    Attributes:
        ids: (N,) tracks.
        points: (N, 3) m, in the anchor's robot frame; NaN if it may as well have been at infinity.
        covariances: (N, 2, 2) m^2, of x and y, with the axes of the anchor but of the landmark relative to
            the robot, as the filter tells it; infinite likewise.
        errors: (N,) m, from where it truly is; NaN likewise.
        depth_errors: (N,) as a share of the true depth; NaN likewise.
        nees: (N,) squared Mahalanobis distance, 3 degrees of freedom; NaN likewise.
        converged: (N,) whether its depth was known well enough.
        seconds: (N,) s until that was so for the first time; infinite if never.
    """

    ids: NDArray[np.int64]
    points: Array
    covariances: Array
    errors: Array
    depth_errors: Array
    nees: Array
    converged: NDArray[np.bool_]
    seconds: Array

    @staticmethod
    def of(run: MappingDrive) -> LastKnown:
        """Go through a run; each moment overwrites what was known before."""
        ids, camera = run.moments[0].landmarks.ids, run.robot.camera
        points, covariances = np.full((len(ids), 3), np.nan), np.full((len(ids), 2, 2), np.inf)
        errors, depth_errors, nees = np.full((3, len(ids)), np.nan)
        converged = np.zeros(len(ids), np.bool_)
        seconds = np.full(len(ids), np.inf)
        for second, moment in zip(run.seconds.tolist(), run.moments, strict=True):
            _, rows, held = np.intersect1d(ids, moment.landmarks.ids, return_indices=True)
            known = LandmarkEstimates._make(column[held] for column in moment.landmarks)
            true, _ = run.truth(known.ids)
            in_robot, turn = moment.true.inverse().apply(true), moment.pose.mean.rotation
            points[rows] = moment.pose.mean.apply(known.points_in_robot)
            covariances[rows] = turn @ known.covariances_in_robot[:, :2, :2] @ turn.T
            errors[rows] = np.linalg.norm(points[rows] - true, axis=1)
            depth_errors[rows] = known.depths / (in_robot[:, 0] - camera.mount_forward) - 1.0
            nees[rows] = landmark_nees(known, in_robot, camera)
            limit = np.maximum(CONVERGED_SIGMA, CONVERGED_SHARE * known.depths)
            good = np.isfinite(known.depths) & (known.depth_sigmas <= limit)
            converged[rows] = good
            seconds[rows[good]] = np.minimum(seconds[rows[good]], second)
        return LastKnown(ids, points, covariances, errors, depth_errors, nees, converged, seconds)


def _pose_figures(who: str, poses: Sequence[Pose2], run: MappingDrive) -> dict[str, float]:
    """Errors at the end and over the run."""
    off = [math.hypot(p.x - m.true.x, p.y - m.true.y) for p, m in zip(poses, run.moments, strict=True)]
    turned = [wrap_angle(p.heading - m.true.heading) for p, m in zip(poses, run.moments, strict=True)]
    return {
        f"{who}_error_m": off[-1],
        f"{who}_error_deg": math.degrees(abs(turned[-1])),
        f"{who}_rmse_m": _rms(np.array(off)),
        f"{who}_rmse_deg": math.degrees(_rms(np.array(turned))),
    }


def _landmark_figures(run: MappingDrive) -> dict[str, float]:
    known = LastKnown.of(run)
    _, flat = run.truth(known.ids)
    shares = _finite(known.depth_errors[known.converged])
    nees = _finite(known.nees)
    return {
        "landmarks": float(len(known.ids)),
        "landmarks_left": float(len(run.moments[-1].landmarks.ids)),
        "landmark_rmse_m": _rms(known.errors),
        "landmark_rmse_converged_m": _rms(known.errors[known.converged]),
        "landmark_rmse_one_surface_m": _rms(known.errors[known.converged & flat]),
        "landmark_error_median_m": _median(_finite(known.errors[known.converged])),
        "depth_error_percent_median": 100.0 * _median(np.abs(shares)),
        "depth_bias_percent_median": 100.0 * _median(shares),
        "nees_landmark": float(nees.mean()) if len(nees) else math.nan,
        "nees_landmark_median": _median(nees),
        "nees_landmark_within_95": float((nees <= WITHIN).mean()) if len(nees) else math.nan,
        "converged_share": float(known.converged.mean()) if len(known.ids) else math.nan,
        "convergence_s_median": _median(known.seconds),
    }


def _track_figures(run: MappingDrive, away: Array) -> dict[str, float]:
    """Figures of all tracks: how long they lived, and how far they were from where they should be."""
    alive = np.concatenate([m.ids for m in run.moments])
    lengths = np.unique(alive, return_counts=True)[1]
    off = [np.linalg.norm(reprojection_errors(run, m), axis=1) for m in run.moments]
    reprojections = _finite(np.concatenate(off))
    true = [track_errors(run, m) for m in run.moments]
    # Only after the first way out is the robot back at the anchor.
    out = int(np.argmax(away > FAR)) if (away > FAR).any() else len(away)
    near = [e for k, e in enumerate(true) if k > out and away[k] < NEAR]
    far = [e for k, e in enumerate(true) if away[k] > FAR]
    return {
        "tracks": float(len(run.ids)),
        "tracks_left": float(len(run.moments[-1].ids)),
        "track_length_median": _median(lengths.astype(float)),
        "track_length_max": float(lengths.max()) if len(lengths) else math.nan,
        "reprojection_px_median": _median(reprojections),
        "reprojection_px_p95": float(np.percentile(reprojections, 95)) if len(reprojections) else math.nan,
        "track_error_px": _rms_norm(true),
        "track_error_back_px": _rms_norm(near),
        "track_error_far_px": _rms_norm(far),
    }


def _rms_norm(errors: Sequence[Array]) -> float:
    return _rms(np.linalg.norm(np.concatenate(errors), axis=1)) if errors else math.nan


def _rms(errors: Array) -> float:
    finite = _finite(errors)
    return float(np.sqrt(np.square(finite).mean())) if len(finite) else math.nan


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else math.nan
