"""The equations of a trail against finite differences and dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.homing.bundle import Bundle
from agent.homing.keyframes import Keyframes
from agent.homing.rays import Rays
from agent.homing.sight import see
from hybridmap.camera import Camera
from hybridmap.pose import Array, Pose2, PoseGaussian

CAMERA = Camera(320, 240, 277.0, 270.0, 159.5, 119.5, mount_height=0.25, mount_forward=0.06)
PLACE = Camera(400, 300, 350.0, 345.0, 199.5, 149.5, mount_height=0.28, mount_forward=0.1)
NOISE = np.array([0.7 / 277.0, 0.7 / 270.0])


def problem(seed: int, images: int = 4, count: int = 7) -> tuple[Bundle, Keyframes, Rays]:
    """An estimate that is somewhat off, with what true postures and landmarks show."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([20, 20], [380, 280], (count, 2))
    points = PLACE.back_project(pixels, rng.uniform(1.5, 5.0, count))
    way = [Pose2(-0.8, 0.3, -0.2)]
    steps = []
    for _ in range(images - 1):
        step = Pose2(*rng.normal([0.12, 0.0, 0.0], [0.03, 0.02, 0.08]))
        way.append(way[-1] @ step)
        steps.append(PoseGaussian.from_sigmas(step @ Pose2(*rng.normal(0, 0.005, 3)), 0.004, 0.01))
    slopes = np.stack(
        [
            (np.array([CAMERA.cx, CAMERA.cy]) - CAMERA.project(pose.inverse().apply(points)))
            / np.array([CAMERA.fx, CAMERA.fy])
            for pose in way
        ]
    )
    slopes[rng.random(slopes.shape[:2]) < 0.2] = np.nan
    postures = np.array([pose.vector for pose in way]) + rng.normal(0.0, 0.01, (images, 3))
    rays = Rays.of(PLACE, pixels, 0.7, 1.0, CAMERA)
    values = rays.values.copy()
    values[:, :2] += rng.normal(0.0, 0.002, (count, 2))
    values[:, 2] = 1.0 / (points[:, 0] - PLACE.mount_forward) + rng.normal(0.0, 0.02, count)
    rays = Rays(
        values, rays.seen, rays.sigmas, rays.inverse_depth_sigmas, rays.mounts, rays.rise, rays.height
    )
    prior = PoseGaussian.from_sigmas(Pose2(-0.7, 0.2, -0.1), 0.5, 0.3)
    return Bundle(prior, NOISE, 3.0), Keyframes(postures, slopes, tuple(steps)), rays


def shifted(frames: Keyframes, rays: Rays, x: Array) -> tuple[Keyframes, Rays]:
    """Postures and rays with one long vector added."""
    k = frames.postures.size
    moved = Rays(
        rays.values + x[k:].reshape(-1, 3), rays.seen, rays.sigmas, rays.inverse_depth_sigmas,
        rays.mounts, rays.rise, rays.height,
    )  # fmt: skip
    return frames.moved(x[:k].reshape(-1, 3)), moved


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_derivatives_of_the_sight_are_those_of_finite_differences(seed):
    _, frames, rays = problem(seed)
    by_posture, by_ray = see(frames, rays, NOISE).slopes(frames, rays, NOISE)
    k, n, step = len(frames.postures), len(rays.values), 1e-6
    ahead = see(frames, rays, NOISE).ahead
    for column in range(3):
        x = np.zeros(3 * k + 3 * n)
        x[column : 3 * k : 3] = step
        there, back = (see(*shifted(frames, rays, sign * x), NOISE).misses for sign in (1, -1))
        np.testing.assert_allclose(by_posture[ahead][..., column], ((there - back) / (2 * step))[ahead], rtol=1e-4, atol=1e-3)  # fmt: skip # noqa: E501
        x = np.zeros(3 * k + 3 * n)
        x[3 * k + column :: 3] = step
        there, back = (see(*shifted(frames, rays, sign * x), NOISE).misses for sign in (1, -1))
        np.testing.assert_allclose(by_ray[ahead][..., column], ((there - back) / (2 * step))[ahead], rtol=1e-4, atol=1e-3)  # fmt: skip # noqa: E501


def test_what_is_seen_is_what_the_camera_projects():
    _, frames, rays = problem(3)
    points = rays.points(np.ones(len(rays.values), np.bool_), 50.0)
    sight = see(frames, rays, NOISE)
    for posture, expected, ahead in zip(frames.postures, sight.expected, sight.ahead, strict=True):
        pixels = CAMERA.project(Pose2.from_vector(posture).inverse().apply(points))
        ours = np.array([CAMERA.cx, CAMERA.cy]) - expected * np.array([CAMERA.fx, CAMERA.fy])
        np.testing.assert_allclose(ours[ahead], pixels[ahead], atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_gradient_is_that_of_the_cost(seed):
    bundle, frames, rays = problem(seed)
    fit = bundle.linearised(frames, rays)
    gradient = np.concatenate([fit.gradient, fit.gradients.ravel()])
    step = 1e-6
    for index in range(len(gradient)):
        x = np.zeros(len(gradient))
        x[index] = step
        slope = (bundle.cost(*shifted(frames, rays, x)) - bundle.cost(*shifted(frames, rays, -x))) / (
            2 * step
        )
        assert abs(slope - gradient[index]) < 1e-4 * max(abs(slope), 100.0)
    assert abs(fit.cost - bundle.cost(frames, rays)) < 1e-9 * fit.cost


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_elimination_of_the_landmarks_changes_nothing(damping):
    bundle, frames, rays = problem(1)
    fit = bundle.linearised(frames, rays)
    k, n = len(fit.gradient), len(fit.gradients)
    dense = np.zeros((k + 3 * n, k + 3 * n))
    dense[:k, :k] = fit.u
    for index in range(n):
        at = slice(k + 3 * index, k + 3 * index + 3)
        dense[at, at], dense[at, :k], dense[:k, at] = fit.v[index], fit.w[index], fit.w[index].T
    right = -np.concatenate([fit.gradient, fit.gradients.ravel()])
    whole = np.linalg.solve(dense + damping * np.diag(np.diag(dense)), right)
    postures, values = fit.step(damping)
    np.testing.assert_allclose(
        np.concatenate([postures.ravel(), values.ravel()]), whole, rtol=1e-6, atol=1e-10
    )
    inverse = np.linalg.inv(dense)
    covariance, sigmas = fit.covariances()
    np.testing.assert_allclose(covariance, inverse[k - 3 : k, k - 3 : k], rtol=1e-6)
    np.testing.assert_allclose(sigmas, np.sqrt(np.diag(inverse)[k + 2 :: 3]), rtol=1e-6)


def test_ways_of_dropped_postures_are_kept():
    """However many images there were: the last ones, the first one, and the whole measured way."""
    frames = Keyframes.starting(Pose2(), 3)
    step = PoseGaussian.from_sigmas(Pose2(0.03, 0.0, 0.02), 0.001, 0.001)
    seen = np.zeros((3, 2))
    nothing = PoseGaussian(Pose2(), np.zeros((3, 3)))
    frames = frames.extended(nothing, seen, (0.05, 0.15), 8, 3)
    whole = Pose2()
    for _ in range(60):
        frames = frames.extended(step, seen, (0.05, 0.15), 8, 3)
        whole = whole @ step.mean
        told = Pose2()
        for way in frames.steps:
            told = told @ way.mean
        assert told.distance(whole) < 1e-9
        assert len(frames.postures) == len(frames.slopes) == len(frames.steps) + 1 <= 8
        assert (frames.postures[0] == 0.0).all()
    # What is kept of the way covers it evenly; the last images are all there.
    gaps = [way.mean.distance(Pose2()) for way in frames.steps]
    assert max(gaps[:-4]) < 0.9
    assert max(gaps[-2:]) < 0.04
