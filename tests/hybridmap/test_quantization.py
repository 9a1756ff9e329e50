"""Landmarks on their grid: rounding is as small as it is said to be, and is done once."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.node import Landmarks
from mapweave.hybridmap.quantization import FINE_BITS, PixelGrid, restore_depths, round_depths, settle, snap

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25, 0.05)
depths = st.floats(0.011, 9.9e3)
shares = st.floats(0.002, 4.0)


@given(depths, shares)
def test_a_depth_is_off_by_little_of_its_sigma(depth: float, share: float):
    back, sigma = (
        float(a[0]) for a in restore_depths(*round_depths(np.array([depth]), np.array([depth * share])))
    )
    assert sigma / back == pytest.approx(share, rel=0.065)
    assert abs(math.log(back / depth)) <= max(share, sigma / back) / 6 + 1e-6


@given(st.integers(1, 63), st.integers(0, 55 * 512))
def test_rounded_values_round_to_themselves(share: int, depth: int):
    steps = np.array([share]), np.array([min(depth, (55 << int(FINE_BITS[share])) - 1)])
    again = round_depths(*restore_depths(*steps))
    assert (again[0][0], again[1][0]) == (steps[0][0], steps[1][0])


def test_steps_are_the_coarsest_that_are_fine_enough():
    share = 0.002 * np.exp(np.arange(63) / 8)
    assert (0.25 / 2.0 ** FINE_BITS[1:] <= share / 3 + 1e-12)[share < 0.75].all()
    finer_than_needed = (0.25 / 2.0 ** (FINE_BITS[1:] - 1) <= share / 3) & (FINE_BITS[1:] > 0)
    assert not finer_than_needed.any()


@pytest.mark.parametrize(
    ("width", "height", "step"), [(320, 240, 1 / 8), (4095, 64, 1 / 8), (4096, 64, 1 / 4), (16384, 16, 1)]
)
def test_pixels_are_off_by_half_a_step(width: int, height: int, step: float):
    grid = PixelGrid.of(Camera(width, height, 100.0, 100.0, 8.0, 8.0, 0.2))
    pixels = np.random.default_rng(3).uniform(-0.45, 1.45, (500, 2)) * [width, height]
    back = grid.restore(*grid.round(pixels))
    assert np.abs(back - pixels).max() == pytest.approx(step / 2, rel=0.05)
    assert np.array_equal(grid.restore(*grid.round(back)), back)


def test_settled_landmarks_are_ordered_by_rows():
    random = np.random.default_rng(4)
    pixels = (random.uniform(0, 1, (60, 2)) * [319, 30]).astype(np.float32)
    codes = random.integers(0, 64, (60, 32)).astype(np.uint8)
    away = random.uniform(0.5, 5, 60).astype(np.float32)
    away[::7] = np.nan
    one, order = settle(Landmarks(pixels, codes, away, away / 20), CAMERA)
    assert sorted(order) == list(range(60))
    assert np.abs(one.pixels - pixels[order]).max() <= 1 / 16
    assert np.array_equal(one.codes, codes[order])
    assert np.array_equal(one.has_depth, np.isfinite(away[order]))
    np.testing.assert_allclose(one.depths, away[order], rtol=0.05 / 6)
    assert sorted(map(tuple, one.pixels[:, ::-1].tolist())) == list(map(tuple, one.pixels[:, ::-1].tolist()))
    again, order = settle(one, CAMERA)
    assert order.tolist() == list(range(60))
    for name in ("pixels", "depths", "depth_sigmas"):
        np.testing.assert_array_equal(getattr(again, name), getattr(one, name))


@pytest.mark.parametrize(
    ("depth", "sigma"), [(0.0, 0.1), (-1.0, 0.1), (1.0, math.nan), (1.0, -0.1), (1.0, math.inf)]
)
def test_invalid_depths_are_refused(depth: float, sigma: float):
    with pytest.raises(InvalidValue):
        round_depths(np.array([depth]), np.array([sigma]))


def test_depths_beyond_use_are_unknown():
    share, depth = round_depths(np.array([0.009, 1.3e4, math.inf, math.nan]), np.ones(4))
    assert not share.any()
    assert not depth.any()
    assert all(np.isnan(a).all() for a in restore_depths(share, depth))


def test_snapped_landmarks_keep_their_order():
    """Edges of a node refer to its landmarks by number, also where a node is written again."""
    random = np.random.default_rng(6)
    pixels = (random.uniform(0, 1, (50, 2)) * [319, 239]).astype(np.float32)
    codes = random.integers(0, 64, (50, 32)).astype(np.uint8)
    away = random.uniform(0.5, 5, 50).astype(np.float32)
    every = Landmarks(pixels, codes, away, away / 20)
    snapped = snap(every, CAMERA)
    assert np.array_equal(snapped.codes, codes)
    assert np.abs(snapped.pixels - pixels).max() <= 1 / 16
    settled, order = settle(every, CAMERA)
    for name in ("pixels", "depths", "depth_sigmas"):
        assert np.array_equal(getattr(settled, name), getattr(snapped, name)[order])
        assert np.array_equal(getattr(snap(snapped, CAMERA), name), getattr(snapped, name))
