"""Distances of points from segments, against points all along them."""

import numpy as np
import pytest

from mapweave.hybridmap.segments import distances


def test_the_distance_is_that_of_the_nearest_point_of_the_segment():
    rng = np.random.default_rng(5)
    points, begin, end = (rng.uniform(-3.0, 3.0, (count, 2)) for count in (20, 30, 30))
    end[::7] = begin[::7]
    along = begin + np.linspace(0.0, 1.0, 4001)[:, None, None] * (end - begin)
    searched = np.array([np.linalg.norm(along - point, axis=-1).min(axis=0) for point in points])
    assert distances(points, begin, end) == pytest.approx(searched, abs=2e-3)
    assert distances(np.zeros((0, 2)), begin, end).shape == (0, 30)
