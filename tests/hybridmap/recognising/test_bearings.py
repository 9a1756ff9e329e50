"""Where a view was taken, from bearings alone: exact without noise, and as other methods have it."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue
from hybridmap.pose import Array, Pose2, wrap_angle
from hybridmap.recognising.bearings import BearingFix, BearingSettings, rays, relate, relate_all
from hybridmap.recognising.epipolar import errors

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
OTHER = Camera(640, 480, 500.0, 510.0, 322.0, 236.0, mount_height=0.3)
SIGMAS = np.full(2, 1.0 / 277.0)


def scene(rng: np.random.Generator, count: int) -> Array:
    """(count, 3) m, in the first camera, which counts as the robot: all around in its view."""
    depth = rng.uniform(1.5, 6.0, count)
    side, rise = rng.uniform(-0.45, 0.45, count), rng.uniform(-0.4, 0.4, count)
    return np.column_stack([depth, side * depth, CAMERA.mount_height + rise * depth])


def two_views(
    b: Pose2, seed: int, count: int = 40, sigma: float = 0.0, camera: Camera = CAMERA
) -> tuple[Array, Array, Array]:
    """Points, and their pixels from the origin and from b; points that b has behind it are left out."""
    rng = np.random.default_rng(seed)
    points = scene(rng, count)
    points = points[b.inverse().apply(points)[:, 0] > 0.3]
    pixels_a, pixels_b = CAMERA.project(points), camera.project(b.inverse().apply(points))
    noise = rng.normal(0.0, sigma, (2, *pixels_a.shape)) if sigma else np.zeros((2, *pixels_a.shape))
    return points, pixels_a + noise[0], pixels_b + noise[1]


def related(pixels_a: Array, pixels_b: Array, camera: Camera = CAMERA, **how: float) -> BearingFix:
    found = relate(pixels_a, CAMERA, pixels_b, camera, np.random.default_rng(0), BearingSettings(**how))
    assert found is not None
    return found


@settings(max_examples=40)
@given(
    heading=st.floats(-0.7, 0.7),
    direction=st.floats(-math.pi, math.pi),
    baseline=st.floats(0.2, 1.2),
    seed=st.integers(0, 10_000),
)
def test_without_noise_it_is_exact(heading, direction, baseline, seed):
    b = Pose2(baseline * math.cos(direction), baseline * math.sin(direction), heading)
    points, pixels_a, pixels_b = two_views(b, seed, camera=OTHER)
    found = related(pixels_a, pixels_b, OTHER)
    assert found.directed
    assert abs(wrap_angle(found.heading - heading)) < 1e-6
    assert abs(wrap_angle(found.direction - direction)) < 1e-6
    assert found.inliers.all()
    # At this precision a point on the baseline itself still has any depth.
    assert np.median(np.abs(found.inverse_depths - baseline / points[:, 0])) < 1e-6


@settings(max_examples=30)
@given(heading=st.floats(-0.7, 0.7), seed=st.integers(0, 10_000))
def test_a_pure_turn_gives_the_heading_and_no_direction(heading, seed):
    _, pixels_a, pixels_b = two_views(Pose2(0.0, 0.0, heading), seed)
    found = related(pixels_a, pixels_b)
    assert not found.directed
    assert abs(found.heading - heading) < 1e-6
    assert found.covariance[1, 1] > 1.0


@pytest.mark.parametrize("heading", [-0.4, 0.0, 0.3])
def test_a_pure_turn_is_told_from_a_drive_in_noise(heading):
    turned, driven = 0, 0
    for seed in range(10):
        _, pixels_a, pixels_b = two_views(Pose2(0.0, 0.0, heading), seed, 60, 1.0)
        turn = related(pixels_a, pixels_b)
        turned += not turn.directed
        assert abs(turn.heading - heading) < 4.0 * math.sqrt(turn.covariance[0, 0])
        _, pixels_a, pixels_b = two_views(Pose2(-0.5, 0.2, heading), seed, 60, 1.0)
        driven += related(pixels_a, pixels_b).directed
    assert turned >= 9
    assert driven == 10


def test_it_agrees_with_the_essential_matrix_of_opencv():
    """OpenCV knows nothing of the plane: five degrees of freedom, in its own axes."""
    for seed in range(10):
        b = Pose2(-0.6, 0.35, 0.25)
        _, pixels_a, pixels_b = two_views(b, seed, 80, 0.02)
        matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
        essential, mask = cv2.findEssentialMat(pixels_a, pixels_b, matrix, cv2.RANSAC, 0.999, 0.3)
        _, rotation, translation, _ = cv2.recoverPose(essential, pixels_a, pixels_b, matrix, mask=mask)
        position = -rotation.T @ translation[:, 0]
        heading = math.atan2(-rotation.T[0, 2], rotation.T[2, 2])
        found = related(pixels_a, pixels_b)
        assert abs(wrap_angle(found.heading - heading)) < 0.01
        assert abs(wrap_angle(found.direction - math.atan2(-position[0], position[2]))) < 0.03


@given(
    theta=st.floats(-1.0, 1.0),
    phi=st.floats(-3.0, 3.0),
    seed=st.integers(0, 1000),
)
def test_errors_are_sampsons_of_the_essential_matrix(theta, phi, seed):
    """The textbook's formula: E = [t]x R, e = a^T E b / |first order change of it|."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-0.5, 0.5, (2, 15, 2))
    t = np.array([math.cos(phi), math.sin(phi), 0.0])
    c, s = math.cos(theta), math.sin(theta)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    essential = cross @ rotation
    ray_a, ray_b = np.column_stack([np.ones(15), a]), np.column_stack([np.ones(15), b])
    value = np.einsum("ni,ij,nj->n", ray_a, essential, ray_b)
    by_a, by_b = (ray_b @ essential.T)[:, 1:], (ray_a @ essential)[:, 1:]
    sampson = value**2 / (0.01**2 * (by_a**2).sum(axis=1) + 0.02**2 * (by_b**2).sum(axis=1))
    ours, _ = errors(a, b, np.array([[theta, phi]]), np.array([0.01, 0.02]))
    np.testing.assert_allclose(ours[0], sampson, rtol=1e-7)


def test_no_posture_of_a_fine_grid_explains_noisy_matches_better():
    theta, phi = np.meshgrid(np.linspace(-0.6, 0.6, 121), np.linspace(-math.pi, math.pi, 181))
    grid = np.stack([theta.ravel(), phi.ravel()], axis=1)
    for seed in range(5):
        _, pixels_a, pixels_b = two_views(Pose2(-0.4, -0.3, 0.2), seed, 40, 1.0)
        a, b = rays(pixels_a, CAMERA), rays(pixels_b, CAMERA)
        found = related(pixels_a, pixels_b)
        mine, _ = errors(a, b, np.array([[found.heading, found.direction]]), SIGMAS)
        theirs, _ = errors(a, b, grid, SIGMAS)
        gate = BearingSettings().gate
        assert np.minimum(mine, gate).sum() <= np.minimum(theirs, gate).sum(axis=1).min() + 0.5


@pytest.mark.parametrize("wrong", [0.2, 0.4])
def test_wrong_matches_are_found_out(wrong):
    b = Pose2(-0.5, 0.4, -0.2)
    for seed in range(10):
        _, pixels_a, pixels_b = two_views(b, seed, 60, 0.5)
        rng = np.random.default_rng(seed)
        bad = rng.random(len(pixels_b)) < wrong
        pixels_b[bad] = rng.uniform(0, [320, 240], (int(bad.sum()), 2))
        found = related(pixels_a, pixels_b, pixel_sigma=0.5)
        assert abs(found.heading - b.heading) < 0.03
        assert abs(wrap_angle(found.direction - math.atan2(b.y, b.x))) < 0.15
        # A wrong match may lie near its line by chance; most do not.
        assert found.inliers[bad].mean() < 0.25
        assert found.inliers[~bad].mean() > 0.9


def test_covariances_are_honest():
    b = Pose2(-0.7, 0.3, 0.15)
    squares = []
    for seed in range(60):
        _, pixels_a, pixels_b = two_views(b, seed, 60, 1.0)
        found = related(pixels_a, pixels_b)
        off = [wrap_angle(found.heading - b.heading), wrap_angle(found.direction - math.atan2(b.y, b.x))]
        squares.append(float(off @ np.linalg.solve(found.covariance, off)))
    # Two degrees of freedom; the mean of sixty is within 0.5 of 2 nine times of ten.
    assert 1.2 < np.mean(squares) < 3.0


def test_landmarks_at_the_cameras_height_leave_more_than_one_answer():
    b = Pose2(-0.8, 0.1, 0.1)
    rng = np.random.default_rng(4)
    points = scene(rng, 8)
    points[:, 2] = CAMERA.mount_height + rng.uniform(-0.1, 0.1, 8)
    noise = rng.normal(0.0, 0.5, (2, 8, 2))
    pixels_a, pixels_b = (
        CAMERA.project(points) + noise[0],
        CAMERA.project(b.inverse().apply(points)) + noise[1],
    )
    few = BearingSettings(pixel_sigma=0.5, least_inliers=5)
    found = relate_all(pixels_a, CAMERA, pixels_b, CAMERA, np.random.default_rng(0), few)
    assert len(found) > 1
    assert min(abs(one.heading - b.heading) for one in found) < 0.1


def test_too_little_is_no_answer():
    _, pixels_a, pixels_b = two_views(Pose2(-0.5, 0.1, 0.1), 0)
    rng = np.random.default_rng(0)
    for count in (0, 1, 5):
        assert relate(pixels_a[:count], CAMERA, pixels_b[:count], CAMERA, rng) is None
    anything = rng.uniform(0, [320, 240], (2, 6, 2))
    strict = BearingSettings(pixel_sigma=0.1)
    assert relate(anything[0], CAMERA, anything[1], CAMERA, rng, strict) is None


@pytest.mark.parametrize(
    ("pixels_a", "pixels_b"),
    [
        (np.zeros((8, 2)), np.zeros((7, 2))),
        (np.zeros((8, 3)), np.zeros((8, 3))),
        (np.full((8, 2), np.nan),) * 2,
    ],
)
def test_what_is_no_pair_of_views_is_refused(pixels_a, pixels_b):
    with pytest.raises(InvalidValue, match="two views"):
        relate(pixels_a, CAMERA, pixels_b, CAMERA, np.random.default_rng(0))
