"""The nearest descriptors against whole numbers, one by one."""

import numpy as np
import pytest

from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.landmark_tables import landmark_tables
from mapweave.mapserver.retrieval.similar_landmarks import GROUPS, SEARCHED, comparable, nearest
from synthetic.world import random_vectors


@pytest.mark.parametrize("count", [0, 3, GROUPS + 1, SEARCHED, 2 * SEARCHED + 77])
@pytest.mark.parametrize("hides", [False, True])
def test_nearest_is_brute_force_and_of_equals_the_first(count: int, hides: bool):
    rng = np.random.default_rng(count)
    # Each several times, so that there are equals at the end of what is returned.
    codes = quantise(random_vectors(count // 5 + 1, rng))[rng.integers(0, count // 5 + 1, count)]
    asked = quantise(random_vectors(20, rng))
    hidden = rng.random(count) < 0.4 if hides else None
    squared, rows = nearest(comparable(codes), asked, 12, hidden)
    for code, found, distances in zip(asked.astype(np.int64), rows, squared, strict=True):
        all_squared = ((codes.astype(np.int64) - code) ** 2).sum(axis=1)
        expected = [int(k) for k in np.argsort(all_squared, kind="stable") if hidden is None or not hidden[k]]
        expected = expected[:12]
        assert found.tolist() == [*expected, *[-1] * (12 - len(expected))]
        assert np.allclose(distances[: len(expected)], all_squared[expected] * landmark_tables().step ** 2)
        assert np.isinf(distances[len(expected) :]).all()
