"""The kernels of recognition against Camera.project, finite differences and dense algebra, in both forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2
from mapweave.registration.gauss_newton import stack_sightings
from mapweave.registration.projection import (
    DEPTH_DECADES,
    Linear,
    Stack,
    determined,
    linearise,
    normal_equations,
    of_pose_alone,
)
from mapweave.registration.sightings import Sightings
from tests.hybridmap.kernel_forms import form

__all__ = ["form"]

CAMERA = Camera(320, 240, 277.0, 270.0, 159.5, 121.0, mount_height=0.25, mount_forward=0.12)
PITCH_SIGMA = 0.02
seeds = st.integers(0, 2**32 - 1)
pytestmark = pytest.mark.usefixtures("form")


def scene(n: int, rng: np.random.Generator, inverted: bool) -> tuple[Sightings, Pose2]:
    """Points in front of a robot and behind it, some with depths, a third of them matched wrongly."""
    true = Pose2(*rng.uniform([-2, -2, -3], [2, 2, 3]))
    pixels = rng.uniform([4, 4], [316, 236], (n, 2))
    depths = rng.uniform(-1.0, 5.0, n)
    points = (true.inverse() if inverted else true).apply(CAMERA.back_project(pixels, depths))
    wrong = rng.random(n) < 0.3
    pixels[wrong] = rng.uniform([4, 4], [316, 236], (int(wrong.sum()), 2))
    half = rng.normal(0, 0.05, (n, 3, 3))
    measured = np.where(rng.random(n) < 0.5, np.abs(depths) + 0.1, np.nan)
    sightings = Sightings.build(
        points, pixels + rng.normal(0, 1, (n, 2)), CAMERA, covariances=half @ half.transpose(0, 2, 1),
        pixel_sigma=0.9, depths=measured, depth_sigmas=0.1 * np.abs(measured), inverted=inverted,
    )  # fmt: skip
    return sightings, true


def predict(stack: Stack, pose_vector: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) u px, v px, depth m, as the camera's own projection has it."""
    pose = Pose2.from_vector(pose_vector)
    rows = []
    for inverted, point in zip(stack.inverted, points, strict=True):
        in_robot = (pose if inverted else pose.inverse()).apply(point[None])
        rows.append([*CAMERA.project(in_robot)[0], in_robot[0, 0] - CAMERA.mount_forward])
    return np.array(rows)


def levelled(pixels: np.ndarray, pitch: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """(N, 2) px, as a level camera sees what one sees that looks up by so much, (N,) rad: by turning rays."""
    centre = np.array([camera.mount_forward, 0.0, camera.mount_height])
    rays = camera.back_project(pixels, np.ones(len(pixels))) - centre
    c, s, zero = np.cos(pitch), np.sin(pitch), np.zeros(len(pixels))
    # Forward, left and up; the axis ahead goes up.
    turns = np.array([[c, zero, -s], [zero, zero + 1.0, zero], [s, zero, c]])
    return camera.project(np.einsum("ijn,nj->ni", turns, rays) + centre)


def derivative(function, steps: list[np.ndarray]) -> np.ndarray:  # type: ignore[no-untyped-def]
    """(N, 3, K) by central differences along K steps."""
    h = 1e-6
    return np.stack([(function(h * step) - function(-h * step)) / (2 * h) for step in steps], axis=-1)


def factors(linear: Linear) -> np.ndarray:
    """(N, 3, 3) Cholesky's factors."""
    out = np.zeros((len(linear.factor), 3, 3))
    for k, (i, j) in enumerate(((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))):
        out[:, i, j] = linear.factor[:, k]
    return out


def expected_ratios(sightings: Sightings, pose_vector: np.ndarray, pitch_sigma: float) -> list[float]:
    """By the densities of scipy, with derivatives by differences."""
    # It takes a second to import, which each process that collects the tests would spend.
    from scipy.stats import multivariate_normal, norm

    stack, ratios = stack_sightings([sightings]), []
    mean = predict(stack, pose_vector, stack.points)
    by_point = derivative(lambda d: predict(stack, pose_vector, stack.points + d), list(np.eye(3)))
    count, h = len(stack.points), 1e-6
    up, down = (levelled(sightings.pixels, np.full(count, pitch)) for pitch in (h, -h))
    by_pitch = pitch_sigma * (up - down) / (2 * h)
    for k, pixel in enumerate(sightings.pixels):
        if mean[k, 2] <= 0.05:
            ratios.append(0.0)
            continue
        spread = by_point[k] @ stack.covariances[k] @ by_point[k].T
        noise = 0.81 * np.eye(2) + np.outer(by_pitch[k], by_pitch[k])
        image = multivariate_normal(mean[k, :2], spread[:2, :2] + noise)
        off = pixel - mean[k, :2]
        ratio, inside = (
            image.logpdf(pixel) + math.log(320 * 240),
            off @ np.linalg.solve(image.cov, off) < 9.21,
        )
        if stack.measured[k]:
            depth, sigma = sightings.depths[k], math.sqrt(spread[2, 2] + stack.noise[k, 2])
            ratio += norm.logpdf(depth, mean[k, 2], sigma) + math.log(depth * DEPTH_DECADES)
            inside &= ((depth - mean[k, 2]) / sigma) ** 2 < 9.21
        ratios.append(max(ratio, 0.0) if inside else 0.0)
    return ratios


@settings(max_examples=15, deadline=None)
@given(seeds, st.integers(3, 12))
def test_likelihoods_are_those_of_a_gaussian(seed: int, n: int):
    """Of a right match, with the depth's beside it, over that of a wrong one; nothing outside the gates."""
    rng = np.random.default_rng(seed)
    for inverted in (False, True):
        sightings, true = scene(n, rng, inverted)
        poses = true.vector + rng.normal(0, 0.05, (4, 3))
        for pitch_sigma in (0.0, 0.02):
            odds = sightings.log_ratios(poses, pitch_sigma)
            for h, pose_vector in enumerate(poses):
                expected = expected_ratios(sightings, pose_vector, pitch_sigma)
                np.testing.assert_allclose(odds[h], expected, atol=1e-3)


@settings(max_examples=15, deadline=None)
@given(seeds, st.integers(3, 12))
def test_linearised_against_finite_differences(seed: int, n: int):
    rng = np.random.default_rng(seed)
    (forward, true), (backward, _) = scene(n, rng, False), scene(n, rng, True)
    stack = stack_sightings([forward, backward], PITCH_SIGMA)
    pose_vector, pitch = true.vector + rng.normal(0, 0.02, 3), rng.normal()
    points = stack.points + rng.normal(0, 0.01, stack.points.shape)
    linear = linearise(stack, np.append(pose_vector, pitch), points)
    signs = PITCH_SIGMA * np.where(stack.inverted, -1.0, 1.0)
    pixels = levelled(stack.observed[:, :2], signs * pitch)
    mean = predict(stack, pose_vector, points)
    seen = mean[:, 2] > 0.4
    pose = Pose2.from_vector(pose_vector)
    by_pose = derivative(
        lambda d: predict(stack, (pose @ Pose2.from_vector(d)).vector, points), list(np.eye(3))
    )
    by_point = derivative(lambda d: predict(stack, pose_vector, points + d), list(np.eye(3)))
    by_pitch = np.zeros((len(points), 3, 1))
    up, down = (levelled(stack.observed[:, :2], signs * (pitch + d)) for d in (1e-6, -1e-6))
    by_pitch[:, :2, 0] = (down - up) / 2e-6
    by_state = np.concatenate([by_pose, by_pitch], axis=2)
    residuals = np.column_stack([pixels, stack.observed[:, 2]]) - mean
    for part in (residuals, by_state, by_point):
        part[~seen] = 0.0  # behind the camera there is nothing to compare, and too near it differences err
    np.testing.assert_allclose(linear.reprojection_px[seen], residuals[seen, :2], atol=1e-8)
    residuals -= (by_point @ (stack.points - points)[:, :, None])[:, :, 0]
    residuals[~stack.measured, 2] = 0.0
    spread = by_point @ stack.covariances @ by_point.transpose(0, 2, 1)
    spread[:, [0, 1, 2], [0, 1, 2]] += stack.noise
    factor = factors(linear)
    np.testing.assert_allclose((factor @ factor.transpose(0, 2, 1))[seen], spread[seen], rtol=1e-4, atol=1e-2)
    rows = factor @ linear.white
    assert not rows[mean[:, 2] <= 0.05].any()
    np.testing.assert_allclose(rows[seen, :, 0], residuals[seen], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(rows[seen, :, 1:], by_state[seen], rtol=1e-4, atol=1e-3)
    distance2 = (residuals * np.linalg.solve(spread, residuals[:, :, None])[:, :, 0]).sum(axis=1)
    ratios = stack.log_wrong - 0.5 * (np.log(np.linalg.det(spread)) + distance2)
    np.testing.assert_allclose(linear.distance2[seen], distance2[seen], rtol=1e-3, atol=1e-3)
    clear = seen & (np.abs(distance2 - stack.gates) > 0.05) & (np.abs(ratios) > 0.05)
    expected = (distance2 < stack.gates) & (ratios > 0)
    assert (linear.inliers[clear] == expected[clear]).all()
    assert not linear.inliers[mean[:, 2] <= 0.05].any()
    inliers = linear.inliers
    np.testing.assert_allclose(linear.log_ratios[seen & inliers], ratios[seen & inliers], atol=1e-3)
    weights = np.where(inliers, 1.0 / (1.0 + np.exp(-np.clip(linear.log_ratios, 0.0, 30.0))), 0.0)
    np.testing.assert_allclose(linear.weights, weights)
    information = sum(
        w * j.T @ np.linalg.solve(s, np.column_stack([r, j]))
        for w, j, s, r in zip(weights, rows[:, :, 1:], spread, residuals, strict=True)
        if w
    )
    if inliers.any() and seen[inliers].all():
        scale = np.abs(information).max()
        information[3, 4], information[3, 0] = information[3, 4] + 1.0, information[3, 0] - pitch
        products = normal_equations(linear, pitch)
        np.testing.assert_allclose(products[1:], information, rtol=1e-3, atol=1e-3 * scale)
        # What is known of the pose whatever the pitch is: the inverse of its part of the covariance.
        covariance = np.linalg.inv(products[1:, 1:] + 1e-6 * scale * np.eye(4))[:3, :3]
        alone = of_pose_alone(products + 1e-6 * scale * np.diag([0.0, 1.0, 1.0, 1.0, 1.0]))
        np.testing.assert_allclose(alone, np.linalg.inv(covariance), rtol=1e-3, atol=1e-6 * scale)


def test_sightings_are_levelled_as_rays_turn():
    rng = np.random.default_rng(5)
    for inverted, sign in ((False, 1.0), (True, -1.0)):
        sightings, _ = scene(20, rng, inverted)
        for pitch in (0.0, 0.02, -0.3):
            expected = levelled(sightings.pixels, np.full(20, sign * pitch))
            np.testing.assert_allclose(sightings.levelled(pitch).pixels, expected, atol=1e-9)


def test_degenerate_points_determine_no_pose():
    assert determined(np.diag([1.0, 1.0, 1e-6]))
    assert not determined(np.diag([1.0, 1.0, 1e-12]))
    assert not determined(np.zeros((3, 3)))
    assert not determined(np.full((3, 3), np.nan))
