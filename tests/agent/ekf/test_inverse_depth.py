"""Landmarks anchored at a node: against Camera.project and finite differences."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapweave import Camera, Pose2
from mapweave.agent.ekf.inverse_depth import points_of_rays, project_anchored, rays_of_points

seeds = st.integers(0, 2**32 - 1)
mounts = st.sampled_from([0.0, 0.12, -0.05])
poses = st.tuples(st.floats(-0.8, 0.8), st.floats(-0.6, 0.6), st.floats(-0.5, 0.5)).map(np.array)


def some_points(seed: int, n: int = 6) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.5, 5.0, n)
    return np.column_stack(
        [depth, rng.uniform(-0.5, 0.5, n) * depth, 0.3 + rng.uniform(-0.4, 0.4, n) * depth]
    )


def derivative(function, at: np.ndarray, h: float = 1e-6) -> np.ndarray:  # type: ignore[no-untyped-def]
    steps = h * np.eye(len(at))
    return np.stack([(function(at + e) - function(at - e)) / (2 * h) for e in steps], axis=-1)


@given(poses, mounts, seeds)
def test_predictions_agree_with_the_camera(pose_vector: np.ndarray, mount: float, seed: int):
    camera = Camera(320, 240, 277.0, 250.0, 160.0, 120.0, 0.3, mount)
    points = some_points(seed)
    rays, _ = rays_of_points(points, mount, 0.3)
    view = project_anchored(pose_vector, rays, mount)
    in_robot = Pose2.from_vector(pose_vector).inverse().apply(points)
    depth = in_robot[:, 0] - mount
    pixels = np.array([160.0, 120.0]) + np.array([277.0, 250.0]) * view.rays[:, :2]
    ahead = depth > 0.05
    np.testing.assert_allclose(pixels[ahead], camera.project(in_robot)[ahead], atol=1e-7)
    np.testing.assert_allclose(view.rays[ahead, 2], 1 / depth[ahead], rtol=1e-9)
    np.testing.assert_allclose(view.scale, depth * rays[:, 2], atol=1e-9)


@given(poses, mounts, seeds)
def test_jacobians_of_the_projection(pose_vector: np.ndarray, mount: float, seed: int):
    rays, _ = rays_of_points(some_points(seed), mount, 0.3)
    view = project_anchored(pose_vector, rays, mount)
    clear = view.scale > 0.1
    by_pose = derivative(lambda p: project_anchored(p, rays, mount).rays, pose_vector)
    np.testing.assert_allclose(view.by_pose[clear], by_pose[clear], rtol=1e-4, atol=1e-6)
    for i in np.flatnonzero(clear):
        by_ray = derivative(lambda r: project_anchored(pose_vector, r[None], mount).rays[0], rays[i])
        np.testing.assert_allclose(view.by_ray[i], by_ray, rtol=1e-4, atol=1e-6)


@given(mounts, seeds)
def test_points_and_rays_are_each_others_inverse(mount: float, seed: int):
    points = some_points(seed)
    rays, by_point = rays_of_points(points, mount, 0.3)
    back, by_ray = points_of_rays(rays, mount, 0.3)
    np.testing.assert_allclose(back, points, atol=1e-9)
    np.testing.assert_allclose(by_ray @ by_point, np.broadcast_to(np.eye(3), by_ray.shape), atol=1e-9)
    numeric = derivative(lambda p: rays_of_points(p[None], mount, 0.3)[0][0], points[0])
    np.testing.assert_allclose(by_point[0], numeric, rtol=1e-5, atol=1e-7)


def test_a_ray_that_may_be_at_infinity_has_no_point():
    points, _ = points_of_rays(np.array([[0.1, 0.1, 0.0], [0.1, 0.1, -0.2]]), 0.0, 0.3)
    assert np.isnan(points).all()
