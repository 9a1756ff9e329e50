"""How far off a mapping run's estimates are, by its truth."""

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.mapping_filter import MappingFilter
from mapweave.agent.settings import FilterSettings
from mapweave.hybridmap.pose import Array
from synthetic.mapping_run import AXLE, WHEEL_NOISE, MappingRun


def follow(run: MappingRun, settings: FilterSettings | None = None) -> MappingFilter:
    """Filter a run, by default with the standard settings."""
    settings = settings or FilterSettings(pixel_sigma=run.pixel_sigma)
    filter_ = MappingFilter(run.camera, AXLE, WHEEL_NOISE, settings)
    ids = np.arange(len(run.points))
    filter_.add(ids, run.pixels[0])
    for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
        filter_.predict(odometry)
        filter_.update(ids, pixels)
    return filter_


def error(run: MappingRun, ids: NDArray[np.int64], pose_vector: Array, points: Array) -> float:
    """RMS distance to the truth of landmarks (N, 3) m in the first robot frame, and of the robot, m."""
    landmarks = np.square(points - run.points[ids]).sum(axis=1)
    robot = np.square(pose_vector[:2] - run.poses[-1].vector[:2]).sum()
    return float(np.sqrt(np.append(landmarks, robot).mean()))


def filter_error(run: MappingRun, filter_: MappingFilter, judged: NDArray[np.bool_]) -> float:
    """The same of a filter, over those of its landmarks that are judged, (N,)."""
    landmarks = filter_.landmarks()
    mask = judged[landmarks.ids] & np.isfinite(landmarks.depths)
    mean = filter_.pose.mean
    return error(run, landmarks.ids[mask], mean.vector, mean.apply(landmarks.points_in_robot[mask]))


def left_out(filter_: MappingFilter, judged: NDArray[np.bool_]) -> int:
    """How many of the landmarks judged have no place in the filter's error."""
    landmarks = filter_.landmarks()
    return int(judged.sum() - (judged[landmarks.ids] & np.isfinite(landmarks.depths)).sum())


def landmark_nees(run: MappingRun, filter_: MappingFilter) -> float:
    """Mean squared Mahalanobis distance of the landmarks in the last camera frame."""
    points = run.poses[-1].inverse().apply(run.points[filter_.ids])
    depth = points[:, 0] - run.camera.mount_forward
    true = np.column_stack([-points[:, 1], run.camera.mount_height - points[:, 2], np.ones(len(depth))])
    off = filter_.state.rays - true / depth[:, None]
    return float(np.einsum("ni,nij,nj->n", off, np.linalg.inv(filter_.state.blocks), off).mean())
