"""Cells in families against brute force."""

import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.retrieval.coarse_quantizer import CoarseQuantizer, coarse_quantizers
from synthetic.world import random_vectors

Codes = NDArray[np.uint8]


def codes_of(count: int, seed: int) -> Codes:
    rng = np.random.default_rng(seed)
    seen = random_vectors(300, rng)[rng.integers(0, 300, count)]
    return quantise(seen + rng.normal(0, 0.08, seen.shape))


def squared(vectors: NDArray[np.float32], centres: Codes) -> NDArray[np.float32]:
    """(N, M) between all."""
    wide = centres.astype(np.float32)
    products = vectors @ wide.T
    out: NDArray[np.float32] = (vectors**2).sum(axis=1)[:, None] - 2 * products + (wide**2).sum(axis=1)
    return out


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_landmark_belongs_to_the_nearest_of_the_nearest_family(number: int):
    quantizer = coarse_quantizers()[number]
    vectors = codes_of(3000, 2).astype(np.float32)
    family = squared(vectors, quantizer.heads).argmin(axis=1)
    own = squared(vectors, quantizer.centres)
    whose = np.repeat(np.arange(len(quantizer.heads)), len(quantizer.heads))
    own[whose[None] != family[:, None]] = np.inf
    expected = own.argmin(axis=1)
    found, rows = quantizer.nearest(vectors), np.arange(len(vectors))
    # Equally near centres are interchangeable.
    assert np.allclose(own[rows, found], own[rows, expected], rtol=1e-4)
    assert (found == expected).mean() > 0.99


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_a_question_finds_nearly_all_of_the_nearest_centres(number: int):
    quantizer = coarse_quantizers()[number]
    vectors = codes_of(200, 4).astype(np.float32)
    nearest = np.argsort(squared(vectors, quantizer.centres), axis=1)[:, :8]
    result = quantizer.searched.search(vectors, 8)[1]
    found = np.mean([len(set(a) & set(b)) / 8 for a, b in zip(nearest, result, strict=True)])
    assert found > 0.9, found


def test_what_are_no_cells_of_codes_is_refused():
    heads, centres = codes_of(4, 5), codes_of(16, 6)
    assert len(CoarseQuantizer(heads, centres)) == 16
    for wrong in ((heads[:0], centres[:0]), (heads, centres[:15]), (heads, centres.astype(np.float32))):
        with pytest.raises(InvalidFile, match="cells"):
            CoarseQuantizer(*wrong)
    assert CoarseQuantizer(heads, centres).nearest(np.zeros((0, 32), np.float32)).shape == (0,)
