"""The mapping filter: its algebra against dense textbook forms, and its reports."""

import numpy as np
import pytest

from mapweave import Camera, Odometry, Pose2
from mapweave.agent.ekf import motion, pixel_noise
from mapweave.agent.ekf.mapping_filter import MappingFilter
from mapweave.agent.ekf.motion import WheelNoise, move_pose, move_rays
from mapweave.agent.settings import FilterSettings
from mapweave.hybridmap.errors import InvalidValue
from synthetic.mapping_run import AXLE, CAMERA, WHEEL_NOISE, MappingRun, draw_run

AHEAD = Camera(320, 240, 277.0, 277.0, 160.0, 120.0, mount_height=0.3, mount_forward=0.1)
STILL = Odometry(0.0, 0.0)


def start(run: MappingRun, side_slip: float = 0.0) -> MappingFilter:
    made = FilterSettings(pixel_sigma=run.pixel_sigma)
    filter_ = MappingFilter(run.camera, AXLE, WHEEL_NOISE, made, side_slip)
    filter_.add(np.arange(len(run.points)), run.pixels[0])
    return filter_


def drive(filter_: MappingFilter, run: MappingRun, first: int = 0, last: int | None = None) -> None:
    ids = np.arange(len(run.points))
    for k in range(first, last or len(run.odometry)):
        filter_.predict(run.odometry[k])
        filter_.update(ids, run.pixels[k + 1])


def a_run(shape: str = "arc", seed: int = 0, steps: int = 120, camera: Camera = CAMERA) -> MappingRun:
    return draw_run(np.random.default_rng(seed), shape, steps, camera=camera)


@pytest.mark.parametrize("camera", [CAMERA, AHEAD])
def test_prediction_is_the_dense_form(camera: Camera):
    run = a_run(camera=camera)
    filter_ = start(run)
    drive(filter_, run, last=60)
    before, step = filter_.state, Odometry(0.03, -0.05)
    filter_.predict(step)
    n = len(before.rays)
    pose_vector, by_pose, pose_by = move_pose(before.pose_vector, step)
    moved = move_rays(before.rays, step, camera.mount_forward)
    a = np.zeros((3 + 3 * n, 3 + 3 * n))
    a[:3, :3] = by_pose
    for i in range(n):
        a[3 + 3 * i : 6 + 3 * i, 3 + 3 * i : 6 + 3 * i] = moved.by_ray[i]
    b = np.vstack([pose_by, moved.by_input.reshape(-1, 3)])[:, :2]
    root = WheelNoise(AXLE, WHEEL_NOISE).root(step)
    dense = a @ before.covariance @ a.T + b @ root @ root.T @ b.T
    np.testing.assert_allclose(filter_.state.covariance, dense, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(filter_.state.pose_vector, pose_vector)


def test_side_slip_moves_robot_and_landmarks_together():
    """Against samples: robots that slip aside by chance, each with the landmarks as it then sees them."""
    run, step, share = a_run(), Odometry(0.05, 0.1), 0.2
    filter_ = start(run, side_slip=share)
    before = filter_.state
    plain = start(run)
    for each in (filter_, plain):
        each.predict(step)
    more = filter_.state.covariance - plain.state.covariance
    sigma = share * (step.forward + AXLE * step.turn)
    rng = np.random.default_rng(0)
    samples = []
    for aside in sigma * rng.normal(size=4000):
        pose_vector, _, _ = move_pose(before.pose_vector, step, aside)
        rays = move_rays(before.rays, step, CAMERA.mount_forward, aside).rays
        samples.append(np.concatenate([pose_vector, rays.ravel()]))
    np.testing.assert_allclose(more, np.cov(np.array(samples).T), atol=0.06 * np.abs(more).max())


def test_update_is_the_textbook_kalman_update(monkeypatch):
    """Without a step before it there is nothing to linearise again: a plain linear update."""
    run = a_run()
    monkeypatch.setattr(pixel_noise, "ADAPTATION", 0.0)
    filter_ = start(run)
    drive(filter_, run, last=60)
    before = filter_.state
    seen = CAMERA.project(run.poses[60].inverse().apply(run.points))
    rng = np.random.default_rng(7)
    pixels = seen + run.pixel_sigma * rng.normal(size=seen.shape)
    report = filter_.update(np.arange(30), pixels)
    assert report.accepted.all()
    h = np.zeros((60, len(before.covariance)))
    for i in range(30):
        h[2 * i, 3 + 3 * i] = h[2 * i + 1, 4 + 3 * i] = 277.0
    z = pixels.ravel() - (h[:, 3:] @ before.rays.ravel() + np.tile([160.0, 120.0], 30))
    s = h @ before.covariance @ h.T + run.pixel_sigma**2 * np.eye(60)
    gain = before.covariance @ h.T @ np.linalg.inv(s)
    joseph = np.eye(len(gain)) - gain @ h
    covariance = joseph @ before.covariance @ joseph.T + run.pixel_sigma**2 * gain @ gain.T
    mean = np.concatenate([before.pose_vector, before.rays.ravel()]) + gain @ z
    got = np.concatenate([filter_.state.pose_vector, filter_.state.rays.ravel()])
    np.testing.assert_allclose(got, mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(filter_.state.covariance, covariance, rtol=1e-6, atol=1e-12)
    assert report.mean_nis == pytest.approx(z @ np.linalg.solve(s, z) / 60)
    np.testing.assert_allclose(report.innovations_px, z.reshape(-1, 2), atol=1e-9)


@pytest.mark.parametrize("camera", [CAMERA, AHEAD])
def test_there_and_back_is_where_it_was(camera: Camera, monkeypatch):
    monkeypatch.setattr(motion, "WHEEL_FLOOR", 0.0)
    run = a_run(camera=camera)
    filter_ = MappingFilter(camera, AXLE, 0.0)
    filter_.add(np.arange(30), run.pixels[0])
    before = filter_.state
    for step in (Odometry(0.2, 0.3), Odometry(-0.2, -0.3)):
        filter_.predict(step)
    np.testing.assert_allclose(filter_.state.pose_vector, before.pose_vector, atol=1e-12)
    np.testing.assert_allclose(filter_.state.rays, before.rays, atol=1e-12)
    np.testing.assert_allclose(filter_.state.covariance, before.covariance, atol=1e-10)


def test_reanchoring_marginalises_the_old_anchor():
    """One filter that goes on from its first anchor, one that is reanchored on the way: same landmarks."""
    run = a_run()
    plain, moved = start(run), start(run)
    drive(plain, run, last=60)
    drive(moved, run, last=60)
    marginal = plain.state.covariance[3:, 3:]
    first = moved.reanchor()
    np.testing.assert_array_equal(moved.state.covariance[3:, 3:], marginal)
    assert not moved.state.covariance[:3].any()
    drive(plain, run, first=60)
    drive(moved, run, first=60)
    a, b = plain.landmarks(), moved.landmarks()
    np.testing.assert_allclose(a.points_in_robot, b.points_in_robot, atol=1e-9)
    np.testing.assert_allclose(a.covariances_in_robot, b.covariances_in_robot, atol=1e-12)
    whole = first.mean @ moved.pose.mean
    # The plain filter may still correct the way to where the other was reanchored: within its sigma.
    assert plain.pose.mahalanobis2(whole) < 3.0


def test_pose_covariance_is_perturbed_on_the_right():
    run = a_run("weave", steps=40)
    filter_ = start(run)
    drive(filter_, run)
    additive = filter_.state.covariance[:3, :3]
    rng = np.random.default_rng(0)
    samples = rng.multivariate_normal(filter_.state.pose_vector, additive, 4000)
    mean = filter_.pose.mean.inverse()
    right = np.array([(mean @ Pose2.from_vector(s)).vector for s in samples])
    expected = filter_.pose.covariance
    np.testing.assert_allclose(np.cov(right.T), expected, atol=0.08 * np.abs(expected).max())


def test_landmark_covariances_are_those_of_samples():
    run = a_run(camera=AHEAD)
    filter_ = start(run)
    drive(filter_, run)
    known, state = filter_.landmarks(), filter_.state
    i = int(np.argmin(known.depth_sigmas / known.depths))
    rng = np.random.default_rng(0)
    rays = rng.multivariate_normal(state.rays[i], state.blocks[i], 20000)
    pixels = rays[:, :2] * 277.0 + (160.0, 120.0)
    points = AHEAD.back_project(pixels, 1 / rays[:, 2])
    scale = np.abs(known.covariances_in_robot[i]).max()
    np.testing.assert_allclose(np.cov(points.T), known.covariances_in_robot[i], atol=0.06 * scale)
    np.testing.assert_allclose(points.mean(axis=0), known.points_in_robot[i], atol=0.1 * np.sqrt(scale))


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_standing_or_turning_gives_no_depth(turn: float):
    run = a_run()
    filter_ = start(run)
    prior = filter_.landmarks().depth_sigmas
    rng = np.random.default_rng(1)
    heading = 0.0
    for k in range(300):
        step = turn * (1 if (k // 15) % 2 == 0 else -1)
        heading += step * (1 + 0.02 * rng.normal())
        seen = CAMERA.project(Pose2(0, 0, heading).inverse().apply(run.points))
        filter_.predict(Odometry(0.0, step))
        filter_.update(np.arange(30), seen + 0.7 * rng.normal(size=seen.shape))
    now = filter_.landmarks()
    held = np.isin(np.arange(30), now.ids)
    relative = np.sqrt(filter_.state.blocks[:, 2, 2]) / (1.2 / 2.5)
    assert (relative > 0.9).all()
    assert (now.depth_sigmas > 0.5 * prior[held]).all()
    assert not filter_.converged().any()


def test_convergence_is_reached_by_driving_and_is_true():
    run = a_run("line", steps=300)
    filter_ = start(run)
    drive(filter_, run)
    converged, known = filter_.converged(), filter_.landmarks()
    assert converged.mean() > 0.8
    true_depth = run.poses[-1].inverse().apply(run.points)[known.ids, 0]
    off = np.abs(known.depths - true_depth)[converged]
    assert (off < 4 * np.maximum(0.05, 0.05 * known.depths[converged])).all()


def test_predicts_where_landmarks_will_be_seen():
    run = a_run("arc", steps=200)
    filter_ = start(run)
    drive(filter_, run, last=199)
    filter_.predict(run.odometry[199])
    expected = filter_.predict_pixels(np.array([5, 77, 3]))
    seen = CAMERA.project(run.poses[200].inverse().apply(run.points))
    assert np.isnan(expected[1]).all()
    assert np.abs(expected[[0, 2]] - seen[[5, 3]]).max() < 4.0
    np.testing.assert_array_equal(filter_.predict_pixels()[filter_.ids == 5][0], expected[0])


def test_the_report_is_about_the_given_ids():
    run = a_run()
    filter_ = start(run)
    filter_.predict(STILL)
    pixels = np.vstack([run.pixels[0][[4, 2]], [[50.0, 50.0]], run.pixels[0][[9]]])
    pixels[3] = np.nan
    report = filter_.update(np.array([4, 2, 99, 9]), pixels)
    assert report.accepted.tolist() == [True, True, False, False]
    assert np.isnan(report.innovations_px[2:]).all()


def test_bad_input_is_refused():
    run = a_run()
    filter_ = start(run)
    with pytest.raises(InvalidValue):
        filter_.add(np.array([3]), np.array([[10.0, 10.0]]))
    with pytest.raises(InvalidValue):
        filter_.add(np.array([40, 40]), np.full((2, 2), 10.0))
    with pytest.raises(InvalidValue):
        filter_.add(np.array([40]), np.array([[10.0, 10.0]]), np.array([0.5]))


def test_landmarks_that_fall_behind_are_let_go():
    filter_ = MappingFilter(CAMERA, AXLE, 0.02)
    filter_.add(
        np.array([1, 2]), np.array([[160.0, 120.0]] * 2), np.array([1.0, 0.2]), np.array([0.01, 0.01])
    )
    for _ in range(6):
        filter_.predict(Odometry(0.2, 0.0))
    assert filter_.ids.tolist() == [2]
    for _ in range(8):
        filter_.predict(Odometry(0.0, 0.2))
    assert len(filter_.ids) == 0
    assert filter_.landmarks().points_in_robot.shape == (0, 3)


def test_removed_between_wheels_and_image():
    """The mapper forgets lost tracks after predict: the pending step must forget them too."""
    run = a_run()
    one, other = start(run), start(run)
    drive(one, run, last=60)
    drive(other, run, last=60)
    gone = np.array([0, 7, 29])
    stay = np.setdiff1d(np.arange(30), gone)
    one.remove(gone)
    one.predict(run.odometry[60])
    other.predict(run.odometry[60])
    other.remove(gone)
    one.update(stay, run.pixels[61][stay])
    other.update(stay, run.pixels[61][stay])
    np.testing.assert_allclose(one.state.covariance, other.state.covariance, atol=1e-14)
    np.testing.assert_allclose(one.state.rays, other.state.rays, atol=1e-12)


def test_few_consistent_among_many_inconsistent_are_rejected():
    run = a_run("line", steps=100)
    filter_ = start(run)
    drive(filter_, run)
    filter_.predict(STILL)
    before = filter_.state
    pixels = filter_.predict_pixels(np.arange(30))
    pixels[3:] = np.random.default_rng(0).uniform((0, 0), (320, 240), (27, 2))
    report = filter_.update(np.arange(30), pixels)
    assert not report.accepted.any()
    assert report.reason.endswith("landmarks agree")
    np.testing.assert_array_equal(filter_.state.covariance, before.covariance)
    np.testing.assert_array_equal(filter_.state.rays, before.rays)
