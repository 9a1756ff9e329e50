"""Which features are tracks, and which are chosen, against brute force."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.mapping.view import associate, even_choice
from mapweave.hybridmap.node import CODE_BYTES
from mapweave.vision.sift import Features

places = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), max_size=14, unique=True)


def features(at: np.ndarray) -> Features:
    """Features of which only the place matters."""
    return Features(at, at, np.zeros((len(at), CODE_BYTES), np.uint8), np.ones(len(at)))


@given(places, places, st.floats(0.5, 6.0))
def test_a_feature_is_the_track_next_to_it(seen, tracked, within):
    # No two distances are the same: whole numbers, and fractions of their own for each.
    result = np.array(seen, float).reshape(-1, 2) + np.linspace(0.01, 0.13, len(seen))[:, None]
    raw = np.array(tracked, float).reshape(-1, 2) + np.linspace(0.17, 0.31, len(tracked))[:, None]
    ids = np.arange(len(raw), dtype=np.int64) * 3 + 5
    tracks = associate(features(result), ids, raw, within)
    for k, at in enumerate(result):
        distances = [float(np.hypot(*(at - point))) for point in raw]
        mine = min(range(len(raw)), key=distances.__getitem__, default=None)
        good = mine is not None and distances[mine] <= within
        if good and mine is not None:
            good = all(np.hypot(*(other - raw[mine])) >= distances[mine] for other in result)
        assert tracks[k] == (ids[mine] if good and mine is not None else -1)
    assert len(set(tracks[tracks >= 0])) == (tracks >= 0).sum(), "no track is two features"


@given(places, places, st.integers(0, 16))
def test_each_choice_is_the_farthest_of_those_left(candidates, taken, most):
    points, far = np.array(candidates, float).reshape(-1, 2), np.array(taken, float).reshape(-1, 2)
    chosen = even_choice(points, far, most).tolist()
    assert len(chosen) == len(set(chosen)) == min(most, len(points))
    for number, first in enumerate(chosen):
        there = [*far, *points[chosen[:number]]]
        if not there:
            assert first == 0, "the strongest comes first"
            continue

        def nearest(k: int, there: list[np.ndarray] = there) -> float:
            return min(float(np.hypot(*(points[k] - second))) for second in there)

        left = set(range(len(points))) - set(chosen[:number])
        assert np.isclose(nearest(first), max(nearest(k) for k in left))
