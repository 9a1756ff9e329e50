"""Planar poses: group axioms, first order calculus against finite differences and sampling."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from mapweave.registration.pose_arrays import PoseGaussians, adjoints, compose_poses, inverse_poses

metres = st.floats(-50, 50)
angles = st.floats(-10, 10)
poses = st.builds(Pose2, metres, metres, angles)


def close(a: Pose2, b: Pose2, tolerance: float = 1e-9) -> bool:
    return a.distance(b) < tolerance and abs(wrap_angle(a.heading - b.heading)) < tolerance


def random_covariance(rng: np.random.Generator, size: float) -> np.ndarray:
    half = rng.normal(0, size, (3, 3))
    return half @ half.T + 1e-6 * np.eye(3)


@given(poses, poses, poses)
def test_composition_is_associative(a: Pose2, b: Pose2, c: Pose2):
    assert close((a @ b) @ c, a @ (b @ c))


@given(poses)
def test_inverse_on_both_sides(a: Pose2):
    assert close(a @ a.inverse(), Pose2())
    assert close(a.inverse() @ a, Pose2())


@given(poses, poses, metres, metres)
def test_composition_acts_on_points_one_after_the_other(a: Pose2, b: Pose2, x: float, y: float):
    point = np.array([[x, y, 0.7]])
    assert np.allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-9)
    assert (a @ b).apply(point)[0, 2] == 0.7


@given(st.floats(-1000, 1000))
def test_wrapped_angle_is_the_same_direction(angle: float):
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@given(poses)
def test_adjoint_against_finite_differences(a: Pose2):
    step = 1e-6
    for k in range(3):
        d = np.zeros(3)
        d[k] = step
        # pose @ delta = (Ad delta) @ pose, so Ad delta = pose @ delta @ pose^-1.
        moved = (a @ Pose2.from_vector(d) @ a.inverse()).vector / step
        assert np.allclose(moved, a.adjoint[:, k], atol=1e-3)


def test_gaussian_composition_and_inverse_against_sampling():
    rng = np.random.default_rng(5)
    a = PoseGaussian(Pose2(1, 2, 0.6), random_covariance(rng, 0.004))
    b = PoseGaussian(Pose2(-3, 0.5, -2.0), random_covariance(rng, 0.004))
    n = 40_000
    sampled_a = compose_poses(
        np.tile(a.mean.vector, (n, 1)), rng.multivariate_normal(np.zeros(3), a.covariance, n)
    )
    sampled_b = compose_poses(
        np.tile(b.mean.vector, (n, 1)), rng.multivariate_normal(np.zeros(3), b.covariance, n)
    )
    for gaussian, samples in (
        (a @ b, compose_poses(sampled_a, sampled_b)),
        (a.inverse(), inverse_poses(sampled_a)),
    ):
        mean = np.tile(gaussian.mean.inverse().vector, (n, 1))
        deviations = compose_poses(mean, samples)
        assert np.allclose(np.cov(deviations.T), gaussian.covariance, rtol=0.06, atol=1e-6)


def test_mahalanobis_distance_of_samples_has_three_degrees_of_freedom():
    rng = np.random.default_rng(6)
    a = PoseGaussian(Pose2(1, 2, 3.0), random_covariance(rng, 0.01))
    samples = rng.multivariate_normal(np.zeros(3), a.covariance, 4000)
    distances = [a.mahalanobis2(a.mean @ Pose2.from_vector(d)) for d in samples]
    assert np.mean(distances) == pytest.approx(3.0, abs=0.15)


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((2, 2)),
        np.diag([1, 1, -1.0]),
        np.full((3, 3), np.nan),
        np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1.0]]),
        np.array([[1, 1e200, 0], [1e200, 1, 0], [0, 0, 1.0]]),  # its squares overflow; found by fuzzing
        np.array([[1, 0, 1e200], [0, 1, 0], [1e200, 0, 1.0]]),
    ],
)
def test_invalid_covariances_are_refused(covariance: np.ndarray):
    with pytest.raises(InvalidValue):
        PoseGaussian(Pose2(), covariance)


@pytest.mark.parametrize("seed", range(200))
def test_the_covariance_check_agrees_with_eigenvalues(seed: int):
    rng = np.random.default_rng(seed)
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    values = 10.0 ** rng.uniform(-8, 3, 3) * rng.choice([1.0, 0.0], 3)
    for beyond in (0.0, 0.5, 2.0, 1e6):
        least = -1e-6 * beyond * max(values.max(), 1e-12)
        one = turned @ np.diag([least, *values[1:]]) @ turned.T
        one = 0.5 * (one + one.T)
        result = np.linalg.eigvalsh(one)[0] / max(np.abs(one).max(), 1e-12)
        if abs(result + 1e-6) > 1e-8:
            assert accepted(one) == (result > -1e-6)


def test_a_covariance_may_be_of_any_size():
    assert accepted(1e200 * np.array([[2, 1, 0], [1, 2, 1], [0, 1, 2.0]]))


def accepted(covariance: np.ndarray) -> bool:
    try:
        PoseGaussian(Pose2(), covariance)
    except InvalidValue:
        return False
    return True


def test_arrays_agree_with_single_poses():
    rng = np.random.default_rng(7)
    first = [
        PoseGaussian(Pose2.from_vector(rng.normal(0, 2, 3)), random_covariance(rng, 0.1)) for _ in range(20)
    ]
    second = [
        PoseGaussian(Pose2.from_vector(rng.normal(0, 2, 3)), random_covariance(rng, 0.1)) for _ in range(20)
    ]
    stacked = [
        PoseGaussians(np.stack([g.mean.vector for g in many]), np.stack([g.covariance for g in many]))
        for many in (first, second)
    ]
    product, inverse = stacked[0] @ stacked[1], stacked[0].inverse()
    for k in range(20):
        expected = first[k] @ second[k]
        assert close(Pose2.from_vector(product.means[k]), expected.mean)
        assert np.allclose(product.covariances[k], expected.covariance)
        assert close(Pose2.from_vector(inverse.means[k]), first[k].inverse().mean)
        assert np.allclose(inverse.covariances[k], first[k].inverse().covariance)
        assert np.allclose(adjoints(stacked[0].means)[k], first[k].mean.adjoint)
        assert stacked[0].distances2()[k] == pytest.approx(
            first[k].inverse().inverse().mahalanobis2(Pose2()), abs=1e9
        )


@given(st.integers(0, 2**32 - 1), st.floats(-6, 2), st.floats(0, 5))
def test_any_decoded_pose_can_be_inverted_and_composed(seed: int, size: float, lever: float):
    """Of any rank, rounded to float32, and seen from kilometres away, where only rounding is left of it."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, rng.integers(1, 4))) * 10.0**size
    rounded = (root @ root.T).astype(np.float32).astype(np.float64)
    pose = PoseGaussian(Pose2(*rng.normal(size=2) * 10.0**lever, rng.uniform(-3, 3)), rounded)
    for item in (
        pose,
        pose.inverse(),
        pose.inverse().inverse(),
        pose @ pose.inverse(),
        pose.inverse() @ pose,
    ):
        values = np.linalg.eigvalsh(item.covariance)
        assert values[0] >= -3e-6 * values[-1]
