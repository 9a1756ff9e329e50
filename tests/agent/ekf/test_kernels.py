"""The compiled products against NumPy's, and both against dense textbook forms."""

import subprocess
import sys
from types import ModuleType

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from agent.ekf import algebra

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
@given(sizes, steps)
def test_transition(size: tuple[int, int], step: tuple[float, float, float]) -> None:
    _, posture, rays, _ = scene(*size)
    one, other = (form.transition(posture, rays, *step) for form in FORMS)
    ahead = one[2] > 0.05
    np.testing.assert_allclose(other[0], one[0], atol=1e-12)
    np.testing.assert_allclose(other[2], one[2], atol=1e-12)
    np.testing.assert_allclose(other[1][ahead], one[1][ahead], atol=1e-9)
    np.testing.assert_allclose(other[3][1:][ahead], one[3][1:][ahead], atol=1e-7)
    np.testing.assert_allclose(other[3][0], one[3][0], atol=1e-12)
    rows = np.concatenate([[True] * 3, np.repeat(ahead, 3)])
    np.testing.assert_allclose(other[4][rows], one[4][rows], atol=1e-7)


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
    rng, _, _, covariance = scene(*size)
    slots, variances = some_slots(rng, n), rng.uniform(0.2, 2.0, 2)
    index = algebra.measured(slots)
    assert index.tolist() == [3 + 3 * int(slot) + k for slot in slots for k in (0, 1)]
    noise = np.diag(np.tile(variances, len(slots)))
    expected_spread = covariance[np.ix_(index, index)] + noise
    information = np.linalg.inv(expected_spread)
    information = 0.5 * (information + information.T)
    residual = rng.normal(size=2 * len(slots))
    gain = covariance[:, index] @ information
    joseph = np.eye(len(covariance))
    joseph[:, index] -= gain
    after = joseph @ covariance @ joseph.T + gain @ noise @ gain.T
    by_input = rng.normal(size=(len(covariance), 3))
    for form in FORMS:
        np.testing.assert_array_equal(form.spread(covariance, slots, variances), expected_spread)
        inverse = form.inverse(expected_spread)
        assert np.array_equal(inverse, inverse.T)
        np.testing.assert_allclose(inverse, information, atol=1e-9)
        step, got = form.condition(covariance, slots, information, variances, residual)
        assert np.array_equal(got, got.T)
        np.testing.assert_allclose(step, gain @ residual, atol=1e-9)
        close(got, after, covariance)
        lever = by_input[index, :2]
        pulled = form.pull(by_input, slots, information, residual)
        np.testing.assert_allclose(
            pulled, (lever.T @ information @ np.column_stack([lever, residual])), atol=1e-8
        )


@settings(deadline=None)
@given(sizes)
def test_choices(size: tuple[int, int]) -> None:
    n, _ = size
    rng, _, rays, _ = scene(*size)
    rays[rng.random(n) < 0.3, 0] *= 10.0
    rays[rng.random(n) < 0.3, 2] = 30.0
    scale = rng.uniform(-0.5, 1.5, n)
    pixels = rays[:, :2].copy()
    pixels[rng.random((n, 2)) < 0.3] = np.nan
    pixels[rng.random((n, 2)) < 0.1] = np.inf
    one, other = (form.ahead(rays, scale, 0.05, 4.0).tolist() for form in FORMS)
    assert (
        one
        == other
        == [bool(w <= 20 and d > 1e-3 and abs(a) <= 4) for (a, _, w), d in zip(rays, scale, strict=True)]
    )
    one, other = (form.finite_rows(pixels).tolist() for form in FORMS)
    assert one == other == [i for i in range(n) if np.isfinite(pixels[i]).all()]


@pytest.mark.parametrize("form", FORMS)
def test_what_is_no_covariance_is_refused(form: ModuleType) -> None:
    with pytest.raises(np.linalg.LinAlgError):
        form.inverse(np.zeros((4, 4)))


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
