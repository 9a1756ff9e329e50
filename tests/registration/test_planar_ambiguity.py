"""The second pose from which a flat thing looks almost the same."""

import math

import numpy as np
import pytest

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2
from mapweave.registration.planar_ambiguity import mirrored
from mapweave.registration.planar_pose import PlanarPoseSettings, solve_planar_pose

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
SETTINGS = PlanarPoseSettings(pixel_sigma=1.0)


def facing(x: float, y: float, point: tuple[float, float]) -> Pose2:
    return Pose2(x, y, math.atan2(point[1] - y, point[0] - x))


def poster(rng: np.random.Generator, size: float, depth: float) -> np.ndarray:
    """Sixty points of a thing of some size (m) at (3, 0), flat but for some depth (m)."""
    return np.column_stack(
        [
            3.0 + rng.uniform(0.0, depth, 60),
            rng.uniform(-size, size, 60) / 2,
            0.3 + rng.uniform(0.0, size, 60),
        ]
    )


@pytest.mark.parametrize("pose_vector", [Pose2(0.2, 1.0, -0.4), Pose2(-1.0, -0.7, 0.1), Pose2(1.0, 0.0, 0.3)])
def test_twice_mirrored_is_where_it_was(pose_vector):
    points = np.array([[3.0, -1.0], [3.1, 0.2], [3.3, 1.5]])
    there = mirrored(pose_vector, points)
    back = mirrored(there, points)
    assert back.distance(pose_vector) < 1e-12
    assert back.heading == pytest.approx(pose_vector.heading)
    middle = [pose.inverse().apply(points.mean(axis=0)) for pose in (pose_vector, there)]
    assert math.atan2(*middle[0][::-1]) == pytest.approx(math.atan2(*middle[1][::-1]))
    assert np.linalg.norm(middle[0]) == pytest.approx(np.linalg.norm(middle[1]))


@pytest.mark.parametrize("seed", range(5))
def test_a_small_flat_thing_seen_from_aside_is_ambiguous(seed):
    """0.4 m at 3 m: perspective is less than the pixels' noise, and the solver must know."""
    rng = np.random.default_rng(seed)
    points = poster(rng, 0.4, 0.0)
    true = facing(0.3, 1.1, (3.0, 0.0))
    pixels = CAMERA.project(true.inverse().apply(points)) + rng.normal(0.0, 0.5, (60, 2))
    fix = solve_planar_pose(points, pixels, CAMERA, rng=rng, settings=SETTINGS)
    assert fix is not None
    assert fix.rival > 0.8
    other = mirrored(fix.node_from_robot.mean, points[:, :2])
    assert min(fix.node_from_robot.mean.distance(true), other.distance(true)) < 0.4


def test_where_either_pose_may_be_the_true_one_the_covariance_covers_both():
    """0.2 to 0.3 m at 3 m: one in five times the wrong one is taken, some 65 of its sigmas from the truth."""
    rng, mistaken = np.random.default_rng(4), []
    for _ in range(60):
        points = poster(rng, float(rng.uniform(0.2, 0.3)), 0.0)
        true = facing(0.3, 1.1, (3.0, 0.0))
        pixels = CAMERA.project(true.inverse().apply(points)) + rng.normal(0.0, 1.0, (60, 2))
        fix = solve_planar_pose(points, pixels, CAMERA, rng=rng, settings=SETTINGS)
        assert fix is not None
        if fix.node_from_robot.mean.distance(true) > 1.0:
            assert fix.rival > 0.8 and fix.rival_distance > 1.0
            mistaken.append(fix.node_from_robot.mahalanobis2(true))
    assert len(mistaken) > 5
    assert np.median(mistaken) < 100.0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("depth", [0.0, 1.5])
def test_wide_or_deep_arrays_are_refused(seed, depth):
    """And the pose found is the right one, whichever of the two the search came upon first."""
    rng = np.random.default_rng(seed)
    points = poster(rng, 0.4 if depth else 2.6, depth)
    true = facing(0.3, 1.1, (3.0, 0.0))
    pixels = CAMERA.project(true.inverse().apply(points)) + rng.normal(0.0, 0.5, (60, 2))
    fix = solve_planar_pose(points, pixels, CAMERA, rng=rng, settings=SETTINGS)
    assert fix is not None
    assert fix.rival < 0.8
    assert fix.node_from_robot.mean.distance(true) < 0.15


def test_a_frontal_view_of_a_wall_has_no_ambiguity():
    rng = np.random.default_rng(1)
    points = poster(rng, 2.0, 0.0)
    pixels = CAMERA.project(points) + rng.normal(0.0, 0.5, (60, 2))
    fix = solve_planar_pose(points, pixels, CAMERA, rng=rng, settings=SETTINGS)
    assert fix is not None
    assert fix.rival == 0.0
