"""The mapping filter's products against dense textbook forms."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapweave import Camera, Odometry
from mapweave.agent.ekf.innovations import (
    LEAF,
    examine,
    innovation_covariance,
    measured_entries,
    turn_by_image,
    wheel_errors,
    whiten,
)
from mapweave.agent.ekf.mapping_state import MappingState, WheelStep
from mapweave.agent.ekf.measurement_model import ImageMeasurement, Pinhole, slots_of
from mapweave.agent.ekf.motion import move_pose, move_rays, propagate
from mapweave.agent.ekf.update_report import Health

sizes = st.tuples(st.integers(1, 14), st.integers(0, 2**32 - 1))
steps = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.8, 0.8), st.floats(-0.2, 0.2))


def scene(n: int, seed: int) -> tuple[np.random.Generator, MappingState]:
    """A pose, rays, and a covariance whose entries are of very different sizes."""
    rng = np.random.default_rng(seed)
    size = 3 + 3 * n
    root = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-4, 0, (size, 1))
    rays = np.column_stack([rng.uniform(-0.6, 0.6, n), rng.uniform(-0.5, 0.5, n), rng.uniform(0.0, 1.5, n)])
    return rng, MappingState(rng.normal(size=3), rays, root @ root.T / size)


def some_slots(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.sort(rng.permutation(n)[: int(rng.integers(1, n + 1))]).astype(np.intp)


def close(first: np.ndarray, second: np.ndarray, covariance: np.ndarray) -> None:
    """Entry ij of two covariances in units of sigma_i sigma_j."""
    sigmas = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(first / np.outer(sigmas, sigmas), second / np.outer(sigmas, sigmas), atol=1e-9)


def dense_inputs(wheel_root: np.ndarray, side_slip: float) -> np.ndarray:
    """(3, 3) covariance of (u1, u2, u3)."""
    inputs = np.zeros((3, 3))
    inputs[:2, :2], inputs[2, 2] = wheel_root @ wheel_root.T, side_slip**2
    return inputs


@settings(deadline=None)
@given(sizes)
def test_propagate(size: tuple[int, int]):
    n, _ = size
    rng, state = scene(*size)
    blocks, by_input = rng.normal(size=(n + 1, 3, 3)), rng.normal(size=(3 + 3 * n, 3))
    input_root = rng.normal(size=(3, 3))
    dense = np.zeros_like(state.covariance)
    for i in range(n + 1):
        dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = blocks[i]
    expected = dense @ state.covariance @ dense.T + by_input @ input_root @ input_root.T @ by_input.T
    got = propagate(state.covariance, blocks, by_input, input_root)
    close(got, expected, expected)
    assert np.array_equal(got, got.T)


@settings(deadline=None)
@given(sizes, steps, st.booleans())
def test_a_step_is_linearised_where_it_is_asked(
    size: tuple[int, int], step: tuple[float, float, float], elsewhere: bool
):
    """The exact motion there, and its derivatives from there to what the wheels say."""
    n, _ = size
    rng, state = scene(*size)
    forward, turn, mount = step
    at = Odometry(forward, turn)
    measured = Odometry(forward + rng.normal(0, 0.02), turn + rng.normal(0, 0.05)) if elsewhere else at
    wheel_root, side_slip = rng.normal(size=(2, 2)) * 0.01, 0.003
    taken = WheelStep(state, measured, wheel_root, side_slip, mount, at, state.pose_vector, state.rays)
    pose_vector, by_pose, pose_by_input = move_pose(state.pose_vector, at)
    moved = move_rays(state.rays, at, mount)
    if moved.scale.min() < 0.05:
        return
    by_input = np.concatenate([pose_by_input, moved.by_input.reshape(-1, 3)])
    dense = np.zeros_like(state.covariance)
    dense[:3, :3] = by_pose
    for i in range(n):
        dense[3 + 3 * i : 6 + 3 * i, 3 + 3 * i : 6 + 3 * i] = moved.by_ray[i]
    covariance = dense @ state.covariance @ dense.T
    covariance += by_input @ dense_inputs(wheel_root, side_slip) @ by_input.T
    further = np.array([measured.forward - forward, measured.turn - turn])
    mean = np.concatenate([pose_vector, moved.rays.ravel()]) + by_input[:, :2] @ further
    after = taken.state
    np.testing.assert_allclose(np.concatenate([after.pose_vector, after.rays.ravel()]), mean, atol=1e-9)
    close(after.covariance, covariance, covariance)


@settings(deadline=None)
@given(sizes)
@example((12, 8437))
@example((40, 5))
@example((70, 5))
def test_the_update_agrees_with_the_textbook(size: tuple[int, int]):
    n, _ = size
    rng, state = scene(*size)
    covariance = state.covariance
    slots, variances = rng.permutation(some_slots(rng, n)), rng.uniform(0.2, 2.0, 2)
    index = measured_entries(slots)
    assert index.tolist() == [3 + 3 * int(slot) + k for slot in slots for k in (0, 1)]
    noise = np.diag(np.tile(variances, len(slots)))
    spread = covariance[np.ix_(index, index)] + noise
    information = np.linalg.inv(spread)
    residual = rng.normal(size=(len(slots), 2))
    r = residual.ravel()
    gain = covariance[:, index] @ information
    joseph = np.eye(len(covariance))
    joseph[:, index] -= gain
    after = joseph @ covariance @ joseph.T + gain @ noise @ gain.T
    before = covariance.copy()
    np.testing.assert_array_equal(innovation_covariance(covariance, slots, variances), spread)
    whitening = whiten(spread)
    np.testing.assert_allclose(np.triu(whitening, 1), 0.0, atol=1e-12)
    np.testing.assert_allclose(whitening.T @ whitening, information, atol=1e-9)
    got, squares = state.corrected(slots, residual, whitening)
    assert np.array_equal(got.covariance, got.covariance.T)
    np.testing.assert_allclose(got.pose_vector, state.pose_vector + (gain @ r)[:3], atol=1e-9)
    np.testing.assert_allclose(got.rays.ravel(), state.rays.ravel() + (gain @ r)[3:], atol=1e-9)
    close(got.covariance, after, covariance)
    assert squares == pytest.approx(r @ information @ r)
    np.testing.assert_array_equal(covariance, before)


@settings(deadline=None)
@given(sizes)
def test_the_wheels_errors_are_estimated_from_an_image(size: tuple[int, int]):
    """Against the posterior of the errors as two more states of a textbook filter."""
    n, _ = size
    rng, state = scene(*size)
    slots, variances = some_slots(rng, n), rng.uniform(0.2, 2.0, 2)
    index, residual = measured_entries(slots), rng.normal(size=(len(slots), 2))
    by_input, root = rng.normal(size=(len(state.covariance), 3)), rng.normal(size=(2, 2)) * 0.1
    lever = by_input[index, :2]
    covariance = state.covariance + by_input[:, :2] @ root @ root.T @ by_input[:, :2].T
    spread = covariance[np.ix_(index, index)] + np.diag(np.tile(variances, len(slots)))
    posterior = root @ root.T @ lever.T @ np.linalg.solve(spread, residual.ravel())
    score = np.linalg.solve(root, posterior)
    certainty = root.T @ lever.T @ np.linalg.solve(spread, lever @ root)
    surprise = np.sqrt(score @ np.linalg.solve(certainty, score))
    got = wheel_errors(by_input, root, slots, whiten(spread), residual)
    np.testing.assert_allclose(got[:2], posterior, rtol=1e-6, atol=1e-9)
    if np.linalg.cond(certainty) < 1e6:
        assert got[2] == pytest.approx(surprise, rel=1e-4)


@settings(deadline=None)
@given(sizes)
def test_an_image_is_examined(size: tuple[int, int]):
    n, _ = size
    rng, state = scene(*size)
    slots, variances = some_slots(rng, n), rng.uniform(0.2, 2.0, 2)
    slopes = state.rays[slots, :2] + rng.normal(size=(len(slots), 2))
    index = measured_entries(slots)
    q = np.linalg.inv(state.covariance[np.ix_(index, index)] + np.diag(np.tile(variances, len(slots))))
    r = (slopes - state.rays[slots, :2]).ravel()
    pairs = [slice(2 * i, 2 * i + 2) for i in range(len(slots))]
    distances = sorted((q @ r)[i] @ np.linalg.solve(q[i, i], (q @ r)[i]) for i in pairs)
    got = examine(state.rays, state.covariance, slots, slopes, variances)
    np.testing.assert_allclose(got.innovations.ravel(), r, atol=1e-14)
    np.testing.assert_allclose(got.whitening.T @ got.whitening, q, atol=1e-9)
    expected = distances[-1], distances[len(distances) // 2]
    assert (got.worst, got.median) == pytest.approx(expected, rel=1e-6)


@settings(deadline=None)
@given(sizes)
def test_landmarks_vote_on_the_turn(size: tuple[int, int]):
    """A turn that all of them see is the vote, unless the wheels forbid it; a quarter may be wrong."""
    n, _ = size
    rng, state = scene(*size)
    rays = state.rays
    slots, root = some_slots(rng, n), rng.normal(size=(2, 2)) * 0.01
    slopes, turn = rays[slots, :2].copy(), 0.01 * rng.normal()
    slopes[:, 0] += turn * (1 + rays[slots, 0] ** 2)
    slopes[: len(slots) // 4, 0] += rng.choice([-5.0, 5.0])
    limit = 4.0 * np.hypot(*root[1])
    assert turn_by_image(rays, slots, slopes, root, 4.0) == pytest.approx(np.clip(turn, -limit, limit))


def test_a_scattered_vote_counts_as_much_as_its_variance_allows():
    """Against a thousand repeated draws: weighed by their variances, vote and wheels err less than either."""
    rng, m = np.random.default_rng(3), 24
    rays, slots = np.zeros((m, 3)), np.arange(m)
    wheel_root = np.array([[0.01, 0.0], [0.0, 0.004]])
    errors = []
    for _ in range(1000):
        beyond = rng.normal(0, 0.004)
        slopes = np.column_stack([beyond + rng.normal(0, 0.02, m), np.zeros(m)])
        errors.append((turn_by_image(rays, slots, slopes, wheel_root, 4.0) - beyond, beyond))
    combined, by_wheels = np.sqrt(np.mean(np.square(errors), axis=0))
    by_vote = 0.02 * np.sqrt(1.2 / m)
    assert combined < 0.95 * min(by_wheels, by_vote)
    assert combined == pytest.approx((by_wheels**-2 + by_vote**-2) ** -0.5, rel=0.1)


@settings(deadline=None)
@given(sizes, st.booleans())
def test_visible_landmarks(size: tuple[int, int], in_order: bool):
    """Against dictionaries: which landmarks are held and seen, and what is reported of all that was given."""
    n, _ = size
    rng, _ = scene(*size)
    held = rng.permutation(3 * n)[:n].astype(np.int64)
    ids = (
        held.copy()
        if in_order
        else rng.permutation(3 * n)[: int(rng.integers(0, 2 * n + 1))].astype(np.int64)
    )
    pixels = rng.uniform(0, 300, (len(ids), 2))
    pixels[rng.random(pixels.shape) < 0.2] = np.nan
    pixels[rng.random(pixels.shape) < 0.05] = np.inf
    pinhole = Pinhole(Camera(320, 240, 270.0, 280.0, 160.0, 120.0, mount_height=0.2))
    place = {int(landmark): slot for slot, landmark in enumerate(held)}
    rows = [k for k in range(len(ids)) if int(ids[k]) in place and np.isfinite(pixels[k]).all()]
    estimated, innovations = rng.random(len(rows)) < 0.5, rng.normal(size=(len(rows), 2))
    assert slots_of(held, ids).tolist() == [place.get(int(landmark), -1) for landmark in ids]
    seen = ImageMeasurement.of(held, ids, pixels, pinhole)
    assert seen.rows.tolist() == rows
    assert seen.slots.tolist() == [place[int(ids[k])] for k in rows]
    np.testing.assert_allclose(pinhole.pixels(seen.slopes), pixels[rows], atol=1e-10)
    report = seen.report(estimated, innovations, 1.0, Health.GOOD, "")
    assert report.accepted.tolist() == [k in np.array(rows, int)[estimated] for k in range(len(ids))]
    np.testing.assert_allclose(report.innovations_px[rows], innovations * pinhole.focal)
    assert np.isnan(np.delete(report.innovations_px, rows, axis=0)).all()


@settings(deadline=None)
@given(sizes)
def test_the_step_is_linearised_at_the_turn_of_the_image(size: tuple[int, int]):
    n, _ = size
    rng, state = scene(*size)
    slots, root = some_slots(rng, n), rng.normal(size=(2, 2)) * 0.01
    measured, variances = Odometry(0.05, 0.02), rng.uniform(0.2, 2.0, 2)
    expected = move_rays(state.rays, measured, 0.1).rays
    step = WheelStep(state, measured, root, 0.003, 0.1, measured, state.pose_vector, expected)
    slopes = expected[slots, :2] + rng.normal(0, 0.01, (len(slots), 2))
    vote = turn_by_image(expected, slots, slopes, root, 4.0)
    after, examined = step.linearised_by_image(slots, slopes, variances, 4.0)
    assert after.at == Odometry(0.05, pytest.approx(0.02 + vote, abs=1e-12))
    alone = step.again(at=after.at).state
    np.testing.assert_allclose(after.state.covariance, alone.covariance)
    for first, second in zip(
        examined, examine(alone.rays, alone.covariance, slots, slopes, variances), strict=True
    ):
        np.testing.assert_allclose(first, second)


@pytest.mark.parametrize("size", [1, 2, 5, LEAF, LEAF + 1, 60, 150])
def test_whitening_of_any_size(size: int):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, 2 * size))
    whitening = whiten(root @ root.T)
    np.testing.assert_allclose(whitening @ root @ root.T @ whitening.T, np.eye(size), atol=1e-10)
    assert not np.triu(whitening, 1).any()


def test_invalid_covariances_are_refused():
    with pytest.raises(np.linalg.LinAlgError):
        whiten(np.zeros((4, 4)))
    with pytest.raises(np.linalg.LinAlgError):
        whiten(np.array([[1.0, 2.0], [2.0, 1.0]]))
