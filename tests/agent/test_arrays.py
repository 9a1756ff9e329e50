"""What stands in for NumPy's functions gives the same, to the last bit."""

import math

import numpy as np
import pytest

from mapweave.agent.arrays import among, lengths, median, same_image


@pytest.mark.parametrize("others", [0, 1, 7, 40])
def test_among_is_isin(others: int):
    rng = np.random.default_rng(others)
    for count in (0, 1, 60):
        ids, held = rng.integers(0, 50, count), rng.integers(0, 50, others)
        found = among(ids, held)
        assert found.dtype == np.bool_
        assert np.array_equal(found, np.isin(ids, held))


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64])
def test_median_is_that_of_numpy(kind: type):
    rng = np.random.default_rng(3)
    for count in range(1, 40):
        values = (100.0 * rng.standard_normal(count)).astype(kind)
        assert median(values) == float(np.median(values))


def test_median_of_nothing_known_is_nan():
    assert math.isnan(median(np.array([1.0, math.nan, 2.0])))


def test_images_are_the_same_to_the_last_grey_level():
    image = np.random.default_rng(5).integers(0, 255, (12, 16), dtype=np.uint8)
    other = image.copy()
    assert same_image(image, other)
    other[-1, -1] ^= 1
    assert not same_image(image, other)
    assert not same_image(image, image[:-1])
    assert not same_image(image, image[:, :-1])


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_lengths_are_those_of_numpy(kind: type):
    rng = np.random.default_rng(4)
    for count in (0, 1, 90):
        vectors = (30.0 * rng.standard_normal((count, 2))).astype(kind)
        vectors[: count // 10] = np.nan
        found = lengths(vectors)
        assert found.dtype == kind
        assert np.array_equal(found, np.linalg.norm(vectors, axis=1), equal_nan=True)
