"""The closed forms of mapweave.agent.ekf.motion against point transforms and finite differences."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapweave import Odometry, Pose2
from mapweave.agent.ekf.motion import WheelNoise, move_pose, move_rays

steps = st.builds(Odometry, st.floats(-0.2, 0.2), st.floats(-0.4, 0.4))
mounts = st.sampled_from([0.0, 0.1, -0.07])
seeds = st.integers(0, 2**32 - 1)


def some_rays(seed: int, n: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.6, 0.6, n), rng.uniform(-0.4, 0.4, n), rng.uniform(0.1, 1.2, n)])


def derivative(function, at: np.ndarray, h: float = 1e-6) -> np.ndarray:  # type: ignore[no-untyped-def]
    columns = []
    for i in range(len(at)):
        e = np.zeros(len(at))
        e[i] = h
        columns.append((function(at + e) - function(at - e)) / (2 * h))
    return np.stack(columns, axis=-1)


@given(steps, mounts, seeds)
def test_rays_move_as_points_do(step: Odometry, mount: float, seed: int):
    rays = some_rays(seed)
    depth = 1.0 / rays[:, 2]
    # In the robot before the step: x forward, y left, z up relative to the camera.
    points = np.column_stack([depth + mount, -rays[:, 0] * depth, -rays[:, 1] * depth])
    after = step.motion().inverse().apply(points)
    forward = after[:, 0] - mount
    expected = np.column_stack([-after[:, 1] / forward, -after[:, 2] / forward, 1.0 / forward])
    moved = move_rays(rays, step, mount)
    np.testing.assert_allclose(moved.rays, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(moved.scale, forward / depth, rtol=1e-9, atol=1e-12)


@given(steps, st.floats(-0.4, 0.4), seeds)
def test_rays_follow_the_exact_form_of_the_notes(step: Odometry, _: float, seed: int):
    rays = some_rays(seed)
    p3 = 1.0 / rays[:, 2]
    p1, p2 = rays[:, 0] * p3, rays[:, 1] * p3
    u1, u2 = step.forward, step.turn
    tx, ty = u1 * np.cos(u2 / 2), u1 * np.sin(u2 / 2)
    p1_after = np.sin(u2) * (p3 - tx) + np.cos(u2) * (p1 + ty)
    p3_after = np.cos(u2) * (p3 - tx) - np.sin(u2) * (p1 + ty)
    expected = np.column_stack([p1_after / p3_after, p2 / p3_after, 1.0 / p3_after])
    np.testing.assert_allclose(move_rays(rays, step, 0.0).rays, expected, rtol=1e-9, atol=1e-12)


@given(steps, mounts, seeds)
def test_jacobians_of_rays(step: Odometry, mount: float, seed: int):
    rays = some_rays(seed)
    moved = move_rays(rays, step, mount)
    for i, ray in enumerate(rays):
        by_ray = derivative(lambda r: move_rays(r[None], step, mount).rays[0], ray)
        np.testing.assert_allclose(moved.by_ray[i], by_ray, rtol=1e-5, atol=1e-7)
    by_input = derivative(
        lambda u: move_rays(rays, Odometry(u[0], u[1]), mount, u[2]).rays,
        np.array([step.forward, step.turn, 0.0]),
    )
    np.testing.assert_allclose(moved.by_input, by_input, rtol=1e-5, atol=1e-7)


@given(steps, st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3))
def test_pose_moves_by_composition_and_its_jacobians(step: Odometry, x: float, y: float, h: float):
    pose_vector = np.array([x, y, h])
    after, by_pose, by_input = move_pose(pose_vector, step)
    expected = Pose2.from_vector(pose_vector) @ step.motion()
    np.testing.assert_allclose(after[:2], expected.vector[:2], atol=1e-12)
    assert abs(np.sin(after[2] - expected.heading)) < 1e-12
    np.testing.assert_allclose(by_pose, derivative(lambda p: move_pose(p, step)[0], pose_vector), atol=1e-8)
    u = np.array([step.forward, step.turn, 0.0])
    numeric = derivative(lambda v: move_pose(pose_vector, Odometry(v[0], v[1]), v[2])[0], u)
    np.testing.assert_allclose(by_input, numeric, atol=1e-8)


@given(steps)
def test_wheel_noise_is_that_of_two_independent_wheels(step: Odometry):
    noise = WheelNoise(axle=0.24, share=0.02)
    ways = np.array([step.forward + 0.12 * step.turn, step.forward - 0.12 * step.turn])
    from_ways = np.array([[0.5, 0.5], [1 / 0.24, -1 / 0.24]])
    expected = from_ways @ np.diag((0.02 * ways) ** 2 + 1e-10) @ from_ways.T
    root = noise.root(step)
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-9, atol=1e-18)
