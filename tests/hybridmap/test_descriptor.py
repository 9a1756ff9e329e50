"""Compact descriptors: the code is what it says, and real features survive it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import skimage.data

from mapweave.hybridmap.descriptor import ZERO, decode, encode, project, quantise, root_sift, rounding_noise
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.landmark_tables import DIMENSIONS, SYMBOLS, landmark_tables
from mapweave.registration.matching import match, match_vectors


def fake_sift(n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).gamma(0.6, 30.0, (n, 128)).astype(np.float32)


def real_sift(image: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    keypoints, result = cv2.SIFT_create(nfeatures=most).detectAndCompute(image, None)
    return np.array([k.pt for k in keypoints]), result


def grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def test_decoded_is_the_nearest_step_of_each_coordinate():
    sift, tables = fake_sift(50, 1), landmark_tables()
    grid = tables.step * (np.arange(SYMBOLS) - ZERO)
    nearest = np.abs(project(sift)[:, :, None] - grid).argmin(axis=2)
    assert np.array_equal(encode(sift), nearest)
    assert np.allclose(decode(encode(sift)), grid[nearest], atol=1e-6)


def test_decoded_values_encode_to_themselves_within_the_range():
    codes = np.random.default_rng(5).integers(0, SYMBOLS, (100, DIMENSIONS)).astype(np.uint8)
    assert np.array_equal(quantise(decode(codes)), codes)
    assert quantise(np.full((1, DIMENSIONS), 1e9)).max() == SYMBOLS - 1
    assert quantise(np.full((1, DIMENSIONS), -1e9)).min() == 0


def test_projection_agrees_with_the_table():
    sift, tables = fake_sift(8, 2), landmark_tables()
    roots = np.sqrt(sift / sift.sum(axis=1, keepdims=True))
    assert np.allclose(project(sift), (roots - tables.mean) @ tables.basis, atol=1e-6)


def test_scale_of_the_input_does_not_matter_and_nothing_is_no_harm():
    sift = fake_sift(5, 3)
    assert np.array_equal(encode(sift), encode(sift / 512))
    assert encode(np.zeros((2, 128))).shape == (2, DIMENSIONS)
    assert encode(np.zeros((0, 128))).shape == (0, DIMENSIONS)
    assert decode(np.zeros((0, DIMENSIONS), np.uint8)).shape == (0, DIMENSIONS)


@pytest.mark.parametrize("wrong", [np.zeros((3, 127)), np.full((1, 128), np.nan), np.zeros(128)])
def test_invalid_sift_settings_are_refused(wrong: np.ndarray):
    with pytest.raises(InvalidValue):
        encode(wrong)


def test_invalid_codes_are_refused():
    with pytest.raises(InvalidValue):
        decode(np.zeros((3, DIMENSIONS), np.int64))  # type: ignore[arg-type]
    with pytest.raises(InvalidValue):
        decode(np.zeros((3, 16), np.uint8))


def test_tables_that_are_none_are_refused():
    good = landmark_tables()
    impossible = good.codes.copy()
    impossible[0, [0, ZERO]] = [0, impossible[0, 0] + impossible[0, ZERO]]
    for wrong in (
        {"codes": good.codes[:, ::2]},
        {"codes": good.codes + 1},
        {"codes": impossible},
        {"cells": -good.cells},
        {"step": 0.0},
        {"basis": good.basis.T},
    ):
        with pytest.raises(InvalidFile):
            replace(good, **wrong)


def test_rounding_adds_the_stated_noise_to_distances():
    """Real descriptors, all pairs, before and after."""
    _, sift = real_sift(skimage.data.coins(), 300)
    exact, rounded = project(sift).astype(np.float64), decode(encode(sift)).astype(np.float64)
    i, j = np.triu_indices(len(sift), 1)
    grown = ((rounded[i] - rounded[j]) ** 2 - (exact[i] - exact[j]) ** 2).sum(axis=1)
    assert grown.mean() == pytest.approx(rounding_noise(), rel=0.25)


def test_codes_keep_right_matches_of_real_photographs():
    """Two cameras side by side, with the true disparity of each pixel; neither photograph was trained on."""
    left, right, disparity = skimage.data.stereo_motorcycle()
    pixels, sift = zip(*(real_sift(grey(image), 500) for image in (left, right)), strict=True)

    def right_ones(pairs: np.ndarray) -> int:
        a, b = pixels[0][pairs[:, 0]], pixels[1][pairs[:, 1]]
        shift = disparity[a[:, 1].round().astype(int), a[:, 0].round().astype(int)]
        known = np.isfinite(shift)
        a, b, shift = a[known], b[known], shift[known]
        return int((np.abs(a - [1, 0] * shift[:, None] - b).max(axis=1) < 2.5).sum())

    full = right_ones(match_vectors(root_sift(sift[0]), root_sift(sift[1])))
    code = right_ones(match(encode(sift[0]), encode(sift[1])))
    assert full > 80
    assert code >= 0.95 * full
