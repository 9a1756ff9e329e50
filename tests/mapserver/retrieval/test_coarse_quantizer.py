"""Means of means against brute force."""

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.descriptor import quantise
from mapweave.mapserver.retrieval import coarse_quantizer as module
from mapweave.mapserver.retrieval.coarse_quantizer import CoarseQuantizer
from synthetic.world import random_vectors


def codes_of(count: int, seed: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    seen = random_vectors(300, rng)[rng.integers(0, 300, count)]
    return quantise(seen + rng.normal(0, 0.08, seen.shape))


def squared(vectors: NDArray[np.float32], means: NDArray[np.float32]) -> NDArray[np.float32]:
    out: NDArray[np.float32] = ((vectors[:, None] - means[None]) ** 2).sum(axis=2)
    return out


def test_a_landmark_belongs_to_the_nearest_of_the_nearest_family() -> None:
    means = CoarseQuantizer.learn(codes_of(4000, 1), 64)
    vectors = codes_of(3000, 2).astype(np.float32)
    family = squared(vectors, means.heads).argmin(axis=1)
    own = squared(vectors, means.means)
    whose = np.repeat(np.arange(len(means.heads)), np.diff(means.starts))
    own[whose[None] != family[:, None]] = np.inf
    expected = own.argmin(axis=1)
    for some in (means.nearest(vectors), means.nearest(vectors[: module.FEW - 1])):
        # Equally near means are interchangeable.
        rows = np.arange(len(some))
        assert np.allclose(own[rows, some], own[rows, expected[: len(some)]], rtol=1e-4)
        assert (some == expected[: len(some)]).mean() > 0.99


def test_a_question_finds_nearly_all_of_the_nearest_means() -> None:
    means = CoarseQuantizer.learn(codes_of(8000, 3), 256)
    vectors = codes_of(200, 4).astype(np.float32)
    nearest = np.argsort(squared(vectors, means.means), axis=1)[:, :8]
    result = means.searched.search(vectors, 8)[1]
    assert len(means.heads) == 16
    assert np.mean([len(set(a) & set(b)) / 8 for a, b in zip(nearest, result, strict=True)]) > 0.9


def test_few_landmarks_make_as_many_means_at_most() -> None:
    means = CoarseQuantizer.learn(codes_of(5, 5), 64)
    assert 1 <= len(means) <= 64 and means.starts[-1] == len(means)
    assert means.nearest(np.zeros((0, 32), np.float32)).shape == (0,)
