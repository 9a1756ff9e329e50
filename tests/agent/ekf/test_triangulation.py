"""Triangulation against truth, against scipy on one track, and where there is nothing to triangulate."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from mapweave import Camera, Pose2
from mapweave.agent.ekf.triangulation import Triangulation, triangulate
from mapweave.hybridmap.errors import InvalidValue
from synthetic.mapping_run import CAMERA, draw_run

AHEAD = Camera(320, 240, 277.0, 277.0, 160.0, 120.0, mount_height=0.3, mount_forward=0.1)


def a_run(camera: Camera = CAMERA, seed: int = 0, landmarks: int = 150):  # type: ignore[no-untyped-def]
    run = draw_run(np.random.default_rng(seed), "weave", 99, landmarks, pixel_sigma=0.7, camera=camera)
    return run, np.array([pose.vector for pose in run.poses])


def points_in_robot(triangulation: Triangulation, camera: Camera) -> np.ndarray:
    """(N, 3) m, in the reference's robot frame."""
    right, down, w = triangulation.rays.T
    return np.column_stack([1 / w + camera.mount_forward, -right / w, camera.mount_height - down / w])


@pytest.mark.parametrize("camera", [CAMERA, AHEAD])
def test_consistent_and_unbiased(camera: Camera):
    run, poses = a_run(camera)
    triangulation = triangulate(poses, run.pixels, camera)
    truth = run.poses[-1].inverse().apply(run.points)
    off = (triangulation.rays[:, 2] - 1 / (truth[:, 0] - camera.mount_forward)) / np.sqrt(
        triangulation.ray_covariances[:, 2, 2]
    )
    assert 0.7 < np.mean(off**2) < 1.4
    assert abs(np.mean(off)) < 0.3
    assert 0.97 < np.mean(triangulation.chi2) < 1.03
    np.testing.assert_allclose(
        points_in_robot(triangulation, camera)[:, 0], triangulation.depths + camera.mount_forward
    )


def test_same_as_scipy_on_one_track():
    run, poses = a_run(AHEAD, landmarks=8)
    triangulation = triangulate(poses, run.pixels, AHEAD, reference=poses[0])
    points = points_in_robot(triangulation, AHEAD)
    for i in range(8):

        def residual(point: np.ndarray, track: int = i) -> np.ndarray:
            seen = np.stack([AHEAD.project(pose.inverse().apply(point)) for pose in run.poses])
            off = (seen - run.pixels[:, track]) / 0.7
            return off[np.isfinite(off)]

        best = least_squares(residual, run.points[i], xtol=1e-12, ftol=1e-12)
        np.testing.assert_allclose(points[i], best.x, rtol=1e-4, atol=1e-5)


def test_reference_frames_agree():
    run, poses = a_run()
    there = points_in_robot(triangulate(poses, run.pixels, CAMERA, reference=poses[30]), CAMERA)
    here = points_in_robot(triangulate(poses, run.pixels, CAMERA), CAMERA)
    moved = (run.poses[-1].inverse() @ run.poses[30]).apply(there)
    np.testing.assert_allclose(moved, here, rtol=1e-3, atol=1e-3)


def test_a_track_that_moves_shows_in_chi2():
    run, poses = a_run()
    pixels = run.pixels.copy()
    pixels[40:, 3] += np.linspace(0, 30, len(poses) - 40)[:, None]
    triangulation = triangulate(poses, pixels, CAMERA)
    assert triangulation.chi2[3] > 4
    assert (np.delete(triangulation.chi2, 3) < 2).all()


def test_pure_rotation_gives_no_depth():
    poses = np.column_stack([np.zeros((30, 2)), np.linspace(-0.2, 0.2, 30)])
    points = np.array([[3.0, 0.2, 0.4], [2.0, -0.3, 0.1]])
    rng = np.random.default_rng(0)
    seen = np.stack([CAMERA.project(Pose2.from_vector(p).inverse().apply(points)) for p in poses])
    triangulation = triangulate(poses, seen + 0.7 * rng.normal(size=seen.shape), CAMERA)
    assert (triangulation.depth_sigmas > 100).all()


def test_tracks_seen_once_or_never_are_nan():
    run, poses = a_run()
    pixels = run.pixels.copy()
    pixels[:, 0] = np.nan
    pixels[1:, 1] = np.nan
    triangulation = triangulate(poses, pixels, CAMERA)
    assert np.isnan(triangulation.depths[:2]).all()
    assert np.isfinite(triangulation.depths[2:]).all()


def test_shapes_are_checked():
    with pytest.raises(InvalidValue):
        triangulate(np.zeros((3, 3)), np.zeros((4, 5, 2)), CAMERA)


def test_tracks_that_fit_to_nothing_are_answered_as_well():
    """Where a camera would come next to the point, one slope outweighs all else, which is rounded away."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        moves = np.column_stack([rng.uniform(0.0, 1.0, 5), rng.normal(0.0, 0.05, (5, 2))])
        pixels = rng.uniform([0.0, 0.0], [CAMERA.width, CAMERA.height], (5, 4000, 2))
        order = rng.random((5, 4000)).argsort(axis=0)
        pixels[order >= rng.integers(1, 3, 4000)] = np.nan
        triangulation = triangulate(moves.cumsum(axis=0), pixels, CAMERA)
        seen = np.isfinite(triangulation.rays).all(axis=1)
        assert seen.any() and (np.linalg.eigvalsh(triangulation.ray_covariances[seen]) > 0.0).all()
