"""The compiled products against NumPy's, and both against dense textbook forms."""

import subprocess
import sys
from types import ModuleType

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from agent.ekf import algebra
from agent.ekf.motion import move_posture, move_rays
from agent.observation import Odometry

compiled = pytest.importorskip("agent.ekf.compiled")
FORMS = (algebra, compiled)

sizes = st.tuples(st.integers(1, 14), st.integers(0, 2**32 - 1))
steps = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.8, 0.8), st.floats(-0.2, 0.2))


def scene(n: int, seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray, np.ndarray]:
    """A posture, rays, and a covariance whose entries are of very different sizes."""
    rng = np.random.default_rng(seed)
    size = 3 + 3 * n
    root = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-4, 0, (size, 1))
    rays = np.column_stack([rng.uniform(-0.6, 0.6, n), rng.uniform(-0.5, 0.5, n), rng.uniform(0.0, 1.5, n)])
    return rng, rng.normal(size=3), rays, root @ root.T / size


def some_slots(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.sort(rng.permutation(n)[: int(rng.integers(1, n + 1))]).astype(np.intp)


def close(one: np.ndarray, other: np.ndarray, covariance: np.ndarray) -> None:
    """Entry ij of two covariances in units of sigma_i sigma_j."""
    sigmas = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(one / np.outer(sigmas, sigmas), other / np.outer(sigmas, sigmas), atol=1e-9)


@settings(deadline=None)
@given(sizes, steps, st.booleans())
def test_transition(size: tuple[int, int], step: tuple[float, float, float], elsewhere: bool) -> None:
    rng, posture, rays, _ = scene(*size)
    forward, turn, mount = step
    at = forward, turn
    told = (forward + rng.normal(0, 0.02), turn + rng.normal(0, 0.05)) if elsewhere else at
    one, other = (form.transition(posture, rays, at, told, mount) for form in FORMS)
    ahead = one[2] > 0.05
    np.testing.assert_allclose(other[0], one[0], atol=1e-12)
    np.testing.assert_allclose(other[2], one[2], atol=1e-12)
    np.testing.assert_allclose(other[1][ahead], one[1][ahead], atol=1e-9)
    np.testing.assert_allclose(other[3][1:][ahead], one[3][1:][ahead], atol=1e-7)
    np.testing.assert_allclose(other[3][0], one[3][0], atol=1e-12)
    rows = np.concatenate([[True] * 3, np.repeat(ahead, 3)])
    np.testing.assert_allclose(other[4][rows], one[4][rows], atol=1e-7)
    # The exact motion where it is linearised, and its derivative from there.
    exact = np.concatenate(
        [move_posture(posture, Odometry(*at))[0], move_rays(rays, Odometry(*at), mount).rays.ravel()]
    )
    expected = exact + one[4][:, :2] @ (np.array(told) - at)
    for form in (one, other):
        np.testing.assert_allclose(
            np.concatenate([form[0], form[1].ravel()])[rows], expected[rows], rtol=1e-9, atol=1e-9
        )


@settings(deadline=None)
@given(sizes)
def test_propagate(size: tuple[int, int]) -> None:
    n, _ = size
    rng, _, _, covariance = scene(*size)
    blocks, by_input, variances = (
        rng.normal(size=(n + 1, 3, 3)),
        rng.normal(size=(3 + 3 * n, 3)),
        rng.random(3),
    )
    wheel_root, side_slip = rng.normal(size=(2, 2)), rng.random()
    inputs = np.zeros((3, 3))
    inputs[:2, :2], inputs[2, 2] = wheel_root @ wheel_root.T, side_slip**2
    dense = np.zeros_like(covariance)
    for i in range(n + 1):
        dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = blocks[i]
    expected = dense @ covariance @ dense.T + by_input @ inputs @ by_input.T
    expected[:3, :3] += np.diag(variances)
    for form in FORMS:
        got = form.propagate(covariance, blocks, by_input, wheel_root, side_slip, variances)
        close(got, expected, expected)
        assert np.array_equal(got, got.T)


@settings(deadline=None)
@given(sizes)
@example((12, 8437))
def test_update_is_the_textbook_one(size: tuple[int, int]) -> None:
    n, _ = size
    rng, posture, rays, covariance = scene(*size)
    slots, variances = rng.permutation(some_slots(rng, n)), rng.uniform(0.2, 2.0, 2)
    index = algebra.measured(slots)
    assert index.tolist() == [3 + 3 * int(slot) + k for slot in slots for k in (0, 1)]
    noise = np.diag(np.tile(variances, len(slots)))
    expected_spread = covariance[np.ix_(index, index)] + noise
    information = np.linalg.inv(expected_spread)
    residual = rng.normal(size=(len(slots), 2))
    r = residual.ravel()
    gain = covariance[:, index] @ information
    joseph = np.eye(len(covariance))
    joseph[:, index] -= gain
    after = joseph @ covariance @ joseph.T + gain @ noise @ gain.T
    for form in FORMS:
        np.testing.assert_array_equal(form.spread(covariance, slots, variances), expected_spread)
        whitening = form.whiten(expected_spread)
        np.testing.assert_allclose(np.triu(whitening, 1), 0.0, atol=1e-12)
        np.testing.assert_allclose(whitening.T @ whitening, information, atol=1e-9)
        np.testing.assert_allclose(whitening @ expected_spread @ whitening.T, np.eye(len(r)), atol=1e-9)
        *mean, got, squares = form.condition(posture, rays, covariance, slots, whitening, residual)
        assert np.array_equal(got, got.T)
        np.testing.assert_allclose(mean[0], posture + (gain @ r)[:3], atol=1e-9)
        np.testing.assert_allclose(mean[1].ravel(), rays.ravel() + (gain @ r)[3:], atol=1e-9)
        close(got, after, covariance)
        assert squares == pytest.approx(r @ information @ r)


@pytest.mark.parametrize("n", [40, 70])
def test_a_large_state_is_updated_like_a_small_one(n: int) -> None:
    """Beyond one tile of the product."""
    rng, posture, rays, covariance = scene(n, 5)
    slots = some_slots(rng, n)
    whitening = algebra.whiten(algebra.spread(covariance, slots, np.ones(2)))
    residual = rng.normal(size=(len(slots), 2))
    one, other = (f.condition(posture, rays, covariance, slots, whitening, residual) for f in FORMS)
    close(other[2], one[2], covariance)
    assert np.array_equal(other[2], other[2].T)


@settings(deadline=None)
@given(sizes)
def test_what_an_image_says_of_the_wheels(size: tuple[int, int]) -> None:
    """Against the posterior of the errors as two more states of a textbook filter."""
    n, _ = size
    rng, _, _, covariance = scene(*size)
    slots, variances = some_slots(rng, n), rng.uniform(0.2, 2.0, 2)
    index, residual = algebra.measured(slots), rng.normal(size=(len(slots), 2))
    by_input, root = rng.normal(size=(len(covariance), 3)), rng.normal(size=(2, 2)) * 0.1
    lever = by_input[index, :2]
    covariance = covariance + by_input[:, :2] @ root @ root.T @ by_input[:, :2].T
    spread = covariance[np.ix_(index, index)] + np.diag(np.tile(variances, len(slots)))
    posterior = root @ root.T @ lever.T @ np.linalg.solve(spread, residual.ravel())
    score = np.linalg.solve(root, posterior)
    certainty = root.T @ lever.T @ np.linalg.solve(spread, lever @ root)
    surprise = np.sqrt(score @ np.linalg.solve(certainty, score))
    for form in FORMS:
        whitening = form.whiten(form.spread(covariance, slots, variances))
        got = form.wheel_errors(by_input, root, slots, whitening, residual)
        np.testing.assert_allclose(got[:2], posterior, rtol=1e-6, atol=1e-9)
        if np.linalg.cond(certainty) < 1e6:
            assert got[2] == pytest.approx(surprise, rel=1e-4)


@settings(deadline=None)
@given(sizes)
def test_an_image_is_examined(size: tuple[int, int]) -> None:
    n, _ = size
    rng, _, rays, covariance = scene(*size)
    slots, variances = some_slots(rng, n), rng.uniform(0.2, 2.0, 2)
    slopes = rays[slots, :2] + rng.normal(size=(len(slots), 2))
    q = np.linalg.inv(algebra.spread(covariance, slots, variances))
    r = (slopes - rays[slots, :2]).ravel()
    pairs = [slice(2 * i, 2 * i + 2) for i in range(len(slots))]
    distances = sorted((q @ r)[i] @ np.linalg.solve(q[i, i], (q @ r)[i]) for i in pairs)
    for form in FORMS:
        innovations, whitening, worst, median = form.examine(rays, covariance, slots, slopes, variances)
        np.testing.assert_allclose(innovations.ravel(), r, atol=1e-14)
        np.testing.assert_allclose(whitening.T @ whitening, q, atol=1e-9)
        assert (worst, median) == pytest.approx((distances[-1], distances[len(distances) // 2]), rel=1e-6)
        np.testing.assert_array_equal(form.innovations(rays, slots, slopes), innovations)


@settings(deadline=None)
@given(sizes)
def test_landmarks_vote_on_the_turn(size: tuple[int, int]) -> None:
    n, _ = size
    rng, _, rays, _ = scene(*size)
    slots, root = some_slots(rng, n), rng.normal(size=(2, 2)) * 0.01
    slopes = rays[slots, :2] + rng.normal(0, 0.01, (len(slots), 2))
    one, other = (form.vote(rays, slots, slopes, root, 4.0) for form in FORMS)
    assert one == pytest.approx(other, rel=1e-9, abs=1e-15)
    # All see the same turn: the vote is certain, unless the wheels forbid it.
    turn = 0.01 * rng.normal()
    slopes[:, 0] = rays[slots, 0] + turn * (1 + rays[slots, 0] ** 2)
    limit = 4.0 * np.hypot(*root[1])
    for form in FORMS:
        assert form.vote(rays, slots, slopes, root, 4.0) == pytest.approx(np.clip(turn, -limit, limit))


@settings(deadline=None)
@given(sizes, st.booleans())
def test_what_is_in_sight(size: tuple[int, int], in_order: bool) -> None:
    """Against dictionaries: which landmarks are held and seen, and what is told of all that was tracked."""
    n, _ = size
    rng, _, _, _ = scene(*size)
    held = rng.permutation(3 * n)[:n].astype(np.int64)
    ids = (
        held.copy()
        if in_order
        else rng.permutation(3 * n)[: int(rng.integers(0, 2 * n + 1))].astype(np.int64)
    )
    pixels = rng.uniform(0, 300, (len(ids), 2))
    pixels[rng.random(pixels.shape) < 0.2] = np.nan
    pixels[rng.random(pixels.shape) < 0.05] = np.inf
    centre, focal = np.array([160.0, 120.0]), np.array([270.0, 280.0])
    place = {int(landmark): slot for slot, landmark in enumerate(held)}
    rows = [k for k in range(len(ids)) if int(ids[k]) in place and np.isfinite(pixels[k]).all()]
    believed, innovations = rng.random(len(rows)) < 0.5, rng.normal(size=(len(rows), 2))
    for form in FORMS:
        assert form.slots_of(held, ids).tolist() == [place.get(int(landmark), -1) for landmark in ids]
        slots, seen, slopes = form.sighted(held, ids, pixels, centre, focal)
        assert seen.tolist() == rows
        assert slots.tolist() == [place[int(ids[k])] for k in rows]
        np.testing.assert_allclose(slopes * focal + centre, pixels[rows], atol=1e-10)
        accepted, told = form.told(len(ids), seen, believed, innovations, focal)
        assert accepted.tolist() == [k in np.array(rows, int)[believed] for k in range(len(ids))]
        np.testing.assert_allclose(told[rows], innovations * focal)
        assert np.isnan(np.delete(told, rows, axis=0)).all()


@settings(deadline=None)
@given(sizes, steps)
def test_where_the_wheels_lead(size: tuple[int, int], step: tuple[float, float, float]) -> None:
    """As the motion has it, landmark by landmark; and which are no longer ahead."""
    n, _ = size
    rng, posture, rays, _ = scene(*size)
    rays[rng.random(n) < 0.3, 0] *= 10.0
    rays[rng.random(n) < 0.3, 2] = 30.0
    forward, turn, mount = step
    moved = move_rays(rays, Odometry(forward, turn), mount)
    told = [
        bool(w <= 20 and d > 1e-3 and abs(a) <= 4)
        for (a, _, w), d in zip(moved.rays, moved.scale, strict=True)
    ]
    for form in FORMS:
        got_posture, got_rays, stays, gone = form.drive(posture, rays, (forward, turn), mount, 0.05, 4.0)
        np.testing.assert_allclose(got_posture, move_posture(posture, Odometry(forward, turn))[0], atol=1e-12)
        np.testing.assert_allclose(got_rays, moved.rays, rtol=1e-9, atol=1e-12)
        assert stays.tolist() == told
        assert gone == told.count(False)


@settings(deadline=None)
@given(sizes)
def test_a_glance_is_its_parts(size: tuple[int, int]) -> None:
    """Vote, transition, propagate and examine, one after the other, each of which is tested by itself."""
    n, _ = size
    rng, posture, rays, covariance = scene(*size)
    slots, root = some_slots(rng, n), rng.normal(size=(2, 2)) * 0.01
    measured, mount, aside = (0.05, 0.02), 0.1, 0.003
    variances, slope_variances = rng.random(3), rng.uniform(0.2, 2.0, 2)
    expected = algebra.transition(posture, rays, measured, measured, mount)[1]
    slopes = expected[slots, :2] + rng.normal(0, 0.01, (len(slots), 2))
    turn = measured[1] + algebra.vote(expected, slots, slopes, root, 4.0)
    moved, after, _, blocks, by_input = algebra.transition(
        posture, rays, (measured[0], turn), measured, mount
    )
    predicted = algebra.propagate(covariance, blocks, by_input, root, aside, variances)
    examined = algebra.examine(after, predicted, slots, slopes, slope_variances)
    for form in FORMS:
        got_turn, *got = form.glance(
            posture, rays, covariance, measured, mount, root, aside, variances, expected, slots, slopes,
            slope_variances, 4.0,
        )  # fmt: skip
        assert got_turn == pytest.approx(turn, abs=1e-12)
        for one, other in zip(got, (moved, after, by_input, predicted, *examined), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("size", [1, 2, 5, 60])
def test_whitening_of_any_size(form: ModuleType, size: int) -> None:
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size + 2))
    whitening = form.whiten(root @ root.T)
    np.testing.assert_allclose(whitening @ root @ root.T @ whitening.T, np.eye(size), atol=1e-10)


@pytest.mark.parametrize("form", FORMS)
def test_what_is_no_covariance_is_refused(form: ModuleType) -> None:
    with pytest.raises(np.linalg.LinAlgError):
        form.whiten(np.zeros((4, 4)))
    with pytest.raises(np.linalg.LinAlgError):
        form.whiten(np.array([[1.0, 2.0], [2.0, 1.0]]))


def test_without_numba_the_filter_runs_in_numpy() -> None:
    """A robot that has installed little: the same estimates to rounding without numba."""
    script = """
import sys
if sys.argv[1] == "without":
    sys.modules["numba"] = None
import numpy as np
from agent.ekf import kernels
from agent.ekf.mapping import MappingFilter
from benchmarks.ekf_run import AXLE, WHEEL_NOISE, draw_run
assert kernels.COMPILED == (sys.argv[1] == "with")
run = draw_run(np.random.default_rng(3), "arc", 60, landmarks=12)
filter_ = MappingFilter(run.camera, AXLE, WHEEL_NOISE)
filter_.add(np.arange(12), run.pixels[0])
for odometry, pixels in zip(run.odometry, run.pixels[1:]):
    filter_.predict(odometry)
    filter_.update(np.arange(12), pixels)
print(*filter_.state.posture, *filter_.state.covariance[:3].ravel())
"""
    printed = []
    for how in ("with", "without"):
        done = subprocess.run(
            [sys.executable, "-c", script, how], capture_output=True, text=True, timeout=120, check=True
        )
        printed.append(np.array(done.stdout.split(), float))
    np.testing.assert_allclose(printed[0], printed[1], rtol=1e-7, atol=1e-12)
