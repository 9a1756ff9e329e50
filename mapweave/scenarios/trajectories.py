"""Trajectories against the truth, by evo: the figures that others' tools give for the same files.

Only evo's core is imported, and late: its command line writes settings into the home directory, its core
does not.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.evaluation.map_score import align
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.scenarios.recording import TrialTrajectory

RPE_DELTA = 1.0
"""m of the true path between the two poses of a pair."""
MAX_STAMP_DIFFERENCE = 0.01
"""s; poses that are farther apart in time do not belong to each other (evo's default)."""


@dataclass(frozen=True, eq=False)
class TrajectoryScore:
    """How good a robot's belief of its way is, in one map.

    Attributes:
        ate_m: absolute trajectory error, RMSE of positions after one planar alignment without scale, m.
        rpe_m: relative pose error over 1 m of the true path, RMSE, m; None for a shorter way.
        rpe_deg: likewise of headings, degrees.
        stamps_ns: (N,) of the poses that have a truth.
        errors: (N,) distance of each from the truth after the alignment, m.
    """

    ate_m: float
    rpe_m: float | None
    rpe_deg: float | None
    stamps_ns: NDArray[np.int64]
    errors: Array


def score_trajectory(truth: TrialTrajectory, estimate: TrialTrajectory) -> TrajectoryScore:
    """Compare one map's trajectory with the truth.

    The alignment is the planar one of `mapweave.evaluation.map_score.align`: where evo's own in three
    dimensions is unique, it is the same, and it also exists for a robot that drove straight ahead or did not
    move.

    Args:
        truth: `world_from_robot`.
        estimate: `map_from_robot`.

    Raises:
        InvalidValue: no time that both know.
    """
    from evo.core import filters, metrics, sync

    try:
        true, estimated = sync.associate_trajectories(
            _evo_trajectory(truth), _evo_trajectory(estimate), max_diff=MAX_STAMP_DIFFERENCE
        )
    except sync.SyncException:
        raise InvalidValue("the truth knows no time of this trajectory") from None
    world_from_map = align(estimated.positions_xyz[:, :2], true.positions_xyz[:, :2])
    estimated.transform(_matrices(world_from_map.vector[None])[0])
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((true, estimated))
    rpe: list[float | None] = []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
        relative = metrics.RPE(relation, RPE_DELTA, metrics.Unit.meters, pairs_from_reference=True)
        try:
            relative.process_data((true, estimated))
        except filters.FilterException:
            rpe.append(None)
        else:
            rpe.append(float(relative.get_statistic(metrics.StatisticsType.rmse)))
    return TrajectoryScore(
        ate_m=float(ape.get_statistic(metrics.StatisticsType.rmse)),
        rpe_m=rpe[0],
        rpe_deg=rpe[1],
        stamps_ns=np.round(np.asarray(true.timestamps) * 1e9).astype(np.int64),
        errors=np.asarray(ape.error, dtype=np.float64),
    )


def _evo_trajectory(trajectory: TrialTrajectory) -> Any:
    """The same for evo."""
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        poses_se3=list(_matrices(trajectory.poses)), timestamps=trajectory.stamps_ns / 1e9
    )


def _matrices(poses: Array) -> Array:
    """(N, 4, 4) rigid motions of (N, 3) planar poses."""
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    matrices[:, 0, 0] = matrices[:, 1, 1] = cos
    matrices[:, 0, 1], matrices[:, 1, 0] = -sin, sin
    matrices[:, :2, 3] = poses[:, :2]
    return matrices
