"""The compiled inner loops against NumPy's, which other tests hold against independent computations."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.camera import Camera
from hybridmap.pose import Pose2
from hybridmap.recognising import algebra
from hybridmap.recognising.pose_refinement import Stack
from hybridmap.recognising.sightings import GATES, LOG_DECADES, NEAREST, Sightings

compiled = pytest.importorskip("hybridmap.recognising.compiled")
CAMERA = Camera(320, 240, 277.0, 270.0, 159.5, 121.0, mount_height=0.25, mount_forward=0.12)
seeds = st.integers(0, 2**32 - 1)


def scene(n: int, rng: np.random.Generator, inverted: bool) -> tuple[Sightings, Pose2]:
    """Points in front of a robot and behind it, some with depths, a third of them matched wrongly."""
    true = Pose2(*rng.uniform([-2, -2, -3], [2, 2, 3]))
    pixels = rng.uniform([4, 4], [316, 236], (n, 2))
    depths = rng.uniform(-1.0, 5.0, n)
    points = (true.inverse() if inverted else true).apply(CAMERA.back_project(pixels, depths))
    wrong = rng.random(n) < 0.3
    pixels[wrong] = rng.uniform([4, 4], [316, 236], (int(wrong.sum()), 2))
    half = rng.normal(0, 0.05, (n, 3, 3))
    told = np.where(rng.random(n) < 0.5, np.abs(depths) + 0.1, np.nan)
    sightings = Sightings.build(
        points, pixels + rng.normal(0, 1, (n, 2)), CAMERA, covariances=half @ half.transpose(0, 2, 1),
        depths=told, depth_sigmas=0.1 * np.abs(told), inverted=inverted,
    )  # fmt: skip
    return sightings, true


@settings(max_examples=50, deadline=None)
@given(seeds, st.integers(1, 40), st.booleans())
def test_hypotheses_weigh_the_same(seed: int, n: int, with_depths: bool) -> None:
    rng = np.random.default_rng(seed)
    s, true = scene(n, rng, False)
    measured = s.depth_measured if with_depths else np.zeros(n, np.bool_)
    poses = np.concatenate([[true.vector], true.vector + rng.normal(0, 0.2, (20, 3))])
    optics = np.array([CAMERA.fx, CAMERA.fy, CAMERA.mount_height, CAMERA.mount_forward, 320.0 * 240.0])
    one, other = (
        form.log_ratios(
            s.points, s.covariances, s.slopes, 0.8, s.depths, s.depth_sigmas, measured, optics, poses,
            GATES[0], NEAREST, LOG_DECADES,
        )
        for form in (algebra, compiled)
    )  # fmt: skip
    assert np.allclose(one, other, rtol=1e-9, atol=1e-7)


@settings(max_examples=50, deadline=None)
@given(seeds, st.integers(3, 40))
def test_refinement_is_the_same(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    forward, true = scene(n, rng, False)
    backward, _ = scene(max(n // 2, 1), rng, True)
    for parts in ([forward], [backward], [forward, backward]):
        stack = Stack.build(parts)
        near = true.vector + rng.normal(0, 0.02, 3)
        one, other = (
            form.linearise(*stack.columns, near, stack.points, NEAREST) for form in (algebra, compiled)
        )
        ahead = np.isfinite(one[1]).all(axis=1)
        assert np.allclose(one[1][ahead], other[1][ahead], rtol=1e-9)
        for k in (0, 2, 3, 4, 5, 6, 8):
            assert np.allclose(one[k], other[k], rtol=1e-6, atol=1e-8 * max(1.0, np.abs(one[k]).max()))
        assert (one[7] == other[7]).all()
        totals = [f.normal_equations(one[0], one[2], one[4], one[8]) for f in (algebra, compiled)]
        for a, b in zip(*totals, strict=True):
            assert np.allclose(a, b, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(a).max()))
        assert algebra.determined(totals[0][0]) == compiled.determined(totals[0][0])
        told = near, 4.0 * np.eye(3)
        (sure, pose, moved), (as_sure, as_pose, as_moved) = (
            form.improve(*stack.columns, near, *told, 3, NEAREST, 1e-4) for form in (algebra, compiled)
        )
        assert sure and as_sure
        assert np.allclose(pose, as_pose, atol=1e-6) and np.allclose(moved, as_moved, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(seeds, st.integers(1, 30))
def test_minimal_solutions_are_the_same(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    sets = rng.normal(size=(n, 3, 3))
    sets[0, 1] = sets[0, 0]  # degenerate
    one, other = (form.from_three_bearings(sets, 0.1) for form in (algebra, compiled))
    assert np.allclose(one, other, rtol=1e-6, atol=1e-6, equal_nan=True)
    there, here = rng.normal(size=(2, n, 2, 2))
    one, other = (form.from_two_points(there, here) for form in (algebra, compiled))
    assert np.allclose(one, other)


@settings(max_examples=50, deadline=None)
@given(seeds, st.integers(1, 20), st.integers(1, 20))
def test_matching_is_the_same_and_exact(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, 64, (n, 32), np.uint8), rng.integers(0, 64, (m, 32), np.uint8)
    exact = ((a[:, None].astype(int) - b[None].astype(int)) ** 2).sum(axis=2)
    for form in (algebra, compiled):
        assert (form.squared_steps(a, b) == exact).all()
        table = rng.integers(0, 5, (n, m)).astype(np.float32)  # with equals
        for (best, least, second), rows in zip(form.two_nearest(table), (table, table.T), strict=True):
            ordered = np.sort(np.column_stack([rows, np.full(len(rows), np.inf)]), axis=1)
            assert (best == rows.argmin(axis=1)).all()
            assert (least == ordered[:, 0]).all() and (second == ordered[:, 1]).all()


def test_without_numba_numpy_serves() -> None:
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "from hybridmap.recognising.kernels import kernels; print(kernels().__name__)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["hybridmap.recognising.algebra"]
