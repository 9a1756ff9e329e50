"""Poses from sightings: Jacobians, likelihood, optimum and covariance against independent computations."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2
from mapweave.registration.minimal_poses import hypotheses
from mapweave.registration.planar_pose import PlanarPoseSettings, solve_planar_pose, solve_sightings
from mapweave.registration.projection import GATE
from mapweave.registration.sightings import Sightings
from tests.hybridmap.kernel_forms import form
from tests.registration.test_projection import levelled

__all__ = ["form"]

pytestmark = pytest.mark.usefixtures("form")

CAMERA = Camera(320, 240, 277.0, 270.0, 159.5, 121.0, mount_height=0.25, mount_forward=0.12)
HONEST = PlanarPoseSettings(pixel_sigma=0.7, scale_sigma=0.0)


def seen_points(pose: Pose2, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) points in node and (n, 2) exact pixels, all in the image."""
    pixels = rng.uniform([4, 4], [316, 236], (n, 2))
    points = pose.apply(CAMERA.back_project(pixels, rng.uniform(1.0, 5.0, n)))
    return points, pixels


def random_pose(rng: np.random.Generator) -> Pose2:
    return Pose2(*rng.uniform([-2, -2, -math.pi], [2, 2, math.pi]))


def error(result: Pose2, true: Pose2) -> float:
    return float(np.abs((true.inverse() @ result).vector).max())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_exact_points_give_the_exact_pose(seed: int):
    rng = np.random.default_rng(seed)
    true = random_pose(rng)
    points, pixels = seen_points(true, 12, rng)
    fix = solve_planar_pose(points, pixels, CAMERA, rng=rng)
    assert fix is not None and fix.inliers.all()
    assert error(fix.node_from_robot.mean, true) < 1e-6


@pytest.mark.parametrize("inverted", [False, True])
def test_minimal_solutions_are_exact(inverted: bool):
    rng = np.random.default_rng(3)
    true = random_pose(rng)
    points, pixels = seen_points(true.inverse() if inverted else true, 30, rng)
    sightings = Sightings.build(points, pixels, CAMERA, inverted=inverted)
    poses = hypotheses(sightings, 50, rng)
    errors = np.array([error(Pose2.from_vector(pose), true) for pose in poses])
    assert (errors[:50] < 1e-6).mean() > 0.8  # three bearings; a draw may repeat a point
    assert (errors[50:] < 1e-6).mean() > 0.8  # two depths


def noisy_problem(
    rng: np.random.Generator, n: int = 40, depth_share: float = 0.04
) -> tuple[Pose2, np.ndarray, np.ndarray, np.ndarray]:
    """A pose near a node; points as a node has them (uncertain along their ray), noisy pixels."""
    true = Pose2(*rng.normal([0, 0, 0], [0.5, 0.4, 0.2]))
    pixels = rng.uniform([4, 4], [316, 236], (n, 2))
    points = true.apply(CAMERA.back_project(pixels, rng.uniform(1.0, 5.0, n)))
    depths = points[:, 0] - CAMERA.mount_forward
    keep = depths > 0.3
    points, pixels, depths = points[keep], pixels[keep], depths[keep]
    rays = np.column_stack([np.ones(len(depths)), points[:, 1] / depths, (points[:, 2] - 0.25) / depths])
    sigmas = depth_share * depths
    covariances = np.einsum("ni,nj,n->nij", rays, rays, sigmas**2)
    lateral = 0.7 * depths / 277.0
    covariances[:, 1, 1] += lateral**2
    covariances[:, 2, 2] += lateral**2
    known = points + rays * (sigmas * rng.normal(0, 1, len(depths)))[:, None]
    known[:, 1:] += rng.normal(0, 1, (len(depths), 2)) * lateral[:, None]
    return true, known, covariances, pixels + rng.normal(0, 0.7, pixels.shape)


def test_covariance_is_calibrated():
    rng = np.random.default_rng(6)
    distances = []
    for _ in range(250):
        true, points, covariances, pixels = noisy_problem(rng)
        fix = solve_planar_pose(
            points, pixels, CAMERA, rng=rng, point_covariances=covariances, settings=HONEST
        )
        assert fix is not None
        distances.append(fix.node_from_robot.mahalanobis2(true))
    # 3 degrees of freedom; the mean of 250 has a standard deviation of 0.155.
    assert 2.3 < np.mean(distances) < 3.6
    assert 0.90 < np.mean(np.array(distances) < 7.81) <= 1.0


@pytest.mark.slow
def test_common_scale_error_is_covered():
    """All depths 2 % too long together, as after a drive with a wrong wheel radius."""
    rng = np.random.default_rng(7)
    covered = {}
    for scale_sigma in (0.0, 0.02):
        distances = []
        for _ in range(120):
            true, points, covariances, pixels = noisy_problem(rng, n=120, depth_share=0.01)
            origin = np.array([CAMERA.mount_forward, 0.0, CAMERA.mount_height])
            points = origin + (points - origin) * rng.normal(1.0, 0.02)
            fix = solve_planar_pose(
                points,
                pixels,
                CAMERA,
                rng=rng,
                point_covariances=covariances,
                settings=PlanarPoseSettings(pixel_sigma=0.7, scale_sigma=scale_sigma),
            )
            assert fix is not None
            distances.append(fix.node_from_robot.mahalanobis2(true))
        covered[scale_sigma] = np.mean(distances)
    assert covered[0.02] < 4.0 < covered[0.0]


def test_optimum_against_scipy_with_points_as_variables():
    """The eliminated points must give the same pose as a full least squares over pose and points."""
    rng = np.random.default_rng(8)
    true, points, covariances, pixels = noisy_problem(rng, n=18, depth_share=0.08)
    fix = solve_planar_pose(points, pixels, CAMERA, rng=rng, point_covariances=covariances, settings=HONEST)
    assert fix is not None and fix.inliers.all()
    roots = np.linalg.inv(np.linalg.cholesky(covariances))

    def residuals(x: np.ndarray) -> np.ndarray:
        moved = x[3:].reshape(-1, 3)
        projected = CAMERA.project(Pose2.from_vector(x[:3]).inverse().apply(moved))
        prior = np.einsum("nij,nj->ni", roots, moved - points)
        return np.concatenate([((pixels - projected) / 0.7).ravel(), prior.ravel()])

    start = np.concatenate([true.vector, points.ravel()])
    optimum = scipy.optimize.least_squares(residuals, start, x_scale="jac")
    # The estimator also weighs each sighting by its probability, hence not to the last digit.
    assert error(fix.node_from_robot.mean, Pose2.from_vector(optimum.x[:3])) < 2e-3
    full = np.linalg.inv(optimum.jac.T @ optimum.jac)[:3, :3]
    rotation = np.eye(3)
    rotation[:2, :2] = Pose2.from_vector(optimum.x[:3]).rotation
    sigmas = np.sqrt(np.diag(rotation.T @ full @ rotation)) * max(1.0, fix.mean_square) ** 0.5
    assert np.allclose(np.sqrt(np.diag(fix.node_from_robot.covariance)), sigmas, rtol=0.05)


def pitched(pixels: np.ndarray, pitch: float) -> np.ndarray:
    """(N, 2) px, in a camera that looks up by so much, of what a level one sees there."""
    return levelled(pixels, np.full(len(pixels), -pitch))


def compared_with_scipy(seed: int, pitch: float) -> tuple[np.ndarray, Callable[[int], float]]:
    """Pose, pitch and covariance are those of a full least squares with the pitch's prior, over the inliers.

    Returns:
        (N,) which are inliers, and the squared normalised residual of one at SciPy's pose and pitch, with its
        point where it fits best.
    """
    rng = np.random.default_rng(seed)
    true, points, covariances, pixels = noisy_problem(rng, n=24, depth_share=0.05)
    pixels = pitched(pixels, pitch)
    model = replace(HONEST, pitch_sigma=0.015)
    fix = solve_planar_pose(points, pixels, CAMERA, rng=rng, point_covariances=covariances, settings=model)
    assert fix is not None
    kept, all_roots = fix.inliers, np.linalg.inv(np.linalg.cholesky(covariances))

    def residuals(pose: np.ndarray, moved: np.ndarray, of: np.ndarray) -> np.ndarray:
        """(K, 5) whitened residuals of some, by their pixels and their points."""
        level = CAMERA.project(Pose2.from_vector(pose[:3]).inverse().apply(moved))
        prior = np.einsum("nij,nj->ni", all_roots[of], moved - points[of])
        return np.hstack([(pixels[of] - pitched(level, pose[3])) / 0.7, prior])

    def of_all(x: np.ndarray) -> np.ndarray:
        return np.append(residuals(x[:4], x[4:].reshape(-1, 3), kept).ravel(), x[3] / 0.015)

    start = np.concatenate([true.vector, [0.0], points[kept].ravel()])
    optimum = scipy.optimize.least_squares(of_all, start, x_scale="jac")
    full = np.linalg.inv(optimum.jac.T @ optimum.jac)[:4, :4]
    # The estimator weighs each sighting by its probability, hence not to the last digit.
    sigmas = np.sqrt(np.diag(full))
    off = np.append(fix.node_from_robot.mean.vector, fix.pitch) - optimum.x[:4]
    assert (np.abs(off) < 0.1 * sigmas).all()
    rotation = np.eye(3)
    rotation[:2, :2] = Pose2.from_vector(optimum.x[:3]).rotation
    expected = np.sqrt(np.diag(rotation.T @ full[:3, :3] @ rotation)) * max(1.0, fix.mean_square) ** 0.5
    assert np.allclose(np.sqrt(np.diag(fix.node_from_robot.covariance)), expected, rtol=0.08)

    def alone(n: int) -> float:
        best = scipy.optimize.least_squares(
            lambda point: residuals(optimum.x[:4], point[None], np.array([n])).ravel(),
            points[n],
            x_scale="jac",
        )
        return float(2.0 * best.cost)

    return kept, alone


@pytest.mark.parametrize("seed", range(12))
def test_pitch_against_scipy_with_points_and_pitch_as_variables(seed: int):
    """The same draws each time: in one of 500 more than two lie outside their gates by chance."""
    pitch = np.random.default_rng([seed, 1]).uniform(-0.03, 0.03)
    kept, _ = compared_with_scipy(seed, pitch)
    assert kept.sum() >= len(kept) - 2


# One sighting of these is inside its gate where its point was given, and outside where that fits best, or the
# other way around.
@example(5727, 0.0)
@example(18, 0.0)
@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.floats(-0.03, 0.03))
def test_inliers_are_those_that_fit_at_the_optimum_of_the_inliers(seed: int, pitch: float):
    """It is an optimum of the truncated cost: all sightings are on the same sides of their gates by SciPy."""
    kept, alone = compared_with_scipy(seed, pitch)
    distance2 = np.array([alone(n) for n in range(len(kept))])
    assert (distance2[kept] < 1.03 * GATE).all() and (distance2[~kept] > 0.97 * GATE).all()


def test_covariance_is_calibrated_where_cameras_look_differently_far_up():
    """Pitch differences are drawn from the prior; a planar pose loses landmarks then, and is too sure."""
    rng = np.random.default_rng(16)
    distances: dict[float, list[float]] = {0.0: [], 0.01: []}
    inliers: dict[float, list[float]] = {0.0: [], 0.01: []}
    for _ in range(150):
        true, points, covariances, pixels = noisy_problem(rng)
        pixels = pitched(pixels, rng.normal(0.0, 0.01))
        for sigma, found in distances.items():
            model = replace(HONEST, pitch_sigma=sigma)
            fix = solve_planar_pose(
                points, pixels, CAMERA, rng=rng, point_covariances=covariances, settings=model
            )
            assert fix is not None
            found.append(fix.node_from_robot.mahalanobis2(true))
            inliers[sigma].append(float(fix.inliers.mean()))
    # 3 degrees of freedom; the mean of 150 has a standard deviation of 0.2.
    assert 2.3 < np.mean(distances[0.01]) < 3.7 < np.mean(distances[0.0])
    assert np.mean(inliers[0.01]) > 0.95 > np.mean(inliers[0.0])


def test_pitch_is_the_same_seen_from_either_side():
    """Points of the robot's own frame in the other camera's image show its pitch with the other sign."""
    rng = np.random.default_rng(17)
    true = Pose2(0.3, -0.1, 0.05)
    points, pixels = seen_points(true.inverse(), 40, rng)
    seen = Sightings.build(points, pitched(pixels, -0.012), CAMERA, inverted=True)
    fix = solve_sightings([seen], rng=rng, settings=replace(HONEST, pitch_sigma=0.05))
    assert fix is not None and fix.inliers.all()
    assert fix.pitch == pytest.approx(0.012, abs=2e-4)
    assert error(fix.node_from_robot.mean, true) < 2e-3


@pytest.mark.parametrize("wrong_share", [0.3, 0.6])
def test_wrong_matches_are_found_out(wrong_share: float):
    rng = np.random.default_rng(9)
    good = 0
    for _ in range(40):
        true, points, covariances, pixels = noisy_problem(rng, n=60)
        wrong = rng.random(len(points)) < wrong_share
        pixels[wrong] = rng.uniform(0, [320, 240], (wrong.sum(), 2))
        fix = solve_planar_pose(points, pixels, CAMERA, rng=rng, point_covariances=covariances)
        assert fix is not None
        good += fix.node_from_robot.mahalanobis2(true) < 16.3
        assert (fix.inliers & wrong).sum() <= 0.12 * wrong.sum() + 2
    assert good >= 39


def test_pure_chance_gives_few_inliers():
    rng = np.random.default_rng(10)
    for _ in range(30):
        points, _ = seen_points(Pose2(), 40, rng)
        fix = solve_planar_pose(points, rng.uniform(0, [320, 240], (40, 2)), CAMERA, rng=rng)
        assert fix is None or fix.inliers.sum() < 10


def test_measured_depths_make_a_pose_more_certain():
    rng = np.random.default_rng(12)
    true, points, covariances, pixels = noisy_problem(rng, n=15, depth_share=0.1)
    in_robot = true.inverse().apply(points)
    depths = in_robot[:, 0] - CAMERA.mount_forward
    without = Sightings.build(points, pixels, CAMERA, covariances=covariances)
    with_depth = Sightings.build(
        points,
        pixels,
        CAMERA,
        covariances=covariances,
        depths=depths,
        depth_sigmas=np.full(len(points), 0.05),
    )
    fixes = [
        solve_sightings([item], rng=rng, settings=PlanarPoseSettings()) for item in (without, with_depth)
    ]
    assert fixes[0] is not None and fixes[1] is not None
    assert fixes[1].node_from_robot.covariance.trace() < fixes[0].node_from_robot.covariance.trace()


@pytest.mark.parametrize("n", [0, 1, 3, 4, 10])
@pytest.mark.parametrize("kind", ["nan", "same point", "behind", "zero", "huge"])
def test_degenerate_input_gives_none_or_a_pose_but_never_raises(n: int, kind: str):
    rng = np.random.default_rng(13)
    points, pixels = seen_points(Pose2(), n, rng)
    if kind == "nan":
        points[:] = np.nan
    elif kind == "same point":
        points[:], pixels[:] = [2.0, 0.1, 0.6], [150.0, 80.0]
    elif kind == "behind":
        points[:, 0] *= -1
    elif kind == "zero":
        points[:] = 0.0
    else:
        points *= 1e8
    fix = solve_planar_pose(points, pixels, CAMERA, rng=rng)
    if fix is not None:
        assert np.isfinite(fix.node_from_robot.covariance).all()
    if n < 4 or kind in ("nan", "same point"):
        assert fix is None


def test_same_seed_same_pose():
    _, points, covariances, pixels = noisy_problem(np.random.default_rng(14), n=60)
    fixes = [
        solve_planar_pose(points, pixels, CAMERA, rng=np.random.default_rng(1), point_covariances=covariances)
        for _ in range(2)
    ]
    assert fixes[0] is not None and fixes[1] is not None
    assert np.array_equal(fixes[0].node_from_robot.mean.vector, fixes[1].node_from_robot.mean.vector)
