"""Which landmarks a node keeps: against a plain loop, and what each of the three wishes does."""

import math
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.descriptor import decode, quantise, rounding_noise
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.node import Landmarks
from mapweave.registration.selection import (
    ALIKE,
    CROWD,
    FIXED_BYTES,
    SelectionSettings,
    choose,
    distinctness,
    worth,
)
from synthetic.world import CAMERA, random_vectors

PLENTY = SelectionSettings(most_bytes=100_000)


def candidates(n: int, seed: int) -> Landmarks:
    random = np.random.default_rng(seed)
    pixels = (random.uniform(0, 1, (n, 2)) * [319, 239]).astype(np.float32)
    depths = random.uniform(0.5, 6.0, n).astype(np.float32)
    return Landmarks(pixels, quantise(random_vectors(n, random)), depths, depths / 30)


def by_hand(landmarks: Landmarks, likely: np.ndarray, settings: SelectionSettings) -> list[int]:
    """The same wish, one landmark and one number at a time."""
    vectors = decode(landmarks.codes).astype(np.float64)
    left, order = set(range(len(landmarks))), []
    while left:
        values = {}
        for i in left:
            others = [
                math.sqrt(max(0.0, float(((vectors[i] - vectors[j]) ** 2).sum()) - rounding_noise()))
                for j in range(len(landmarks))
                if j != i
            ]
            distinct = min(1.0, min(others, default=math.inf) / ALIKE)
            crowd = 1.0
            for j in order:
                away = math.dist(landmarks.pixels[i], landmarks.pixels[j]) / CAMERA.width
                crowd += math.exp(-(away**2) / (2 * CROWD**2))
            values[i] = likely[i] * distinct / crowd
        best = max(left, key=lambda i: values[i])
        order.append(best)
        left.remove(best)
    return order


@pytest.mark.parametrize("n", [0, 1, 2, 25])
def test_against_a_plain_loop(n: int):
    some = candidates(n, n)
    likely = np.random.default_rng(n).uniform(0.3, 1.3, n)
    assert choose(some, likely, CAMERA, PLENTY).tolist() == by_hand(some, likely, PLENTY)


def test_more_bytes_keep_more_of_the_same():
    some, likely = candidates(150, 1), np.random.default_rng(1).uniform(0.3, 1.3, 150)
    kept = [choose(some, likely, CAMERA, SelectionSettings(b)).tolist() for b in (700, 1000, 2000, 10_000)]
    for fewer, more in pairwise(kept):
        assert more[: len(fewer)] == fewer
        assert len(more) > len(fewer)
    assert len(kept[-1]) == 150


def test_twins_come_last():
    """Similar landmarks are ambiguous, so no match of theirs passes the ratio test."""
    some = candidates(40, 2)
    some.codes[30:] = some.codes[30]
    order = choose(some, np.ones(40), CAMERA, PLENTY)
    assert set(order[30:]) == set(range(30, 40))
    assert (distinctness(some, 0.5)[30:] == 0).all()


def test_the_first_selected_landmarks_cover_the_image():
    """Nine tenths of the candidates are in one corner."""
    some = candidates(150, 3)
    some.pixels[:135] *= 0.2
    kept = choose(some, np.ones(150), CAMERA, SelectionSettings(900))
    assert len(kept) < 40
    assert (kept >= 135).sum() >= 12


def test_tracked_and_strong_landmarks_come_first():
    seen, rank = np.array([1.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.9])
    likely = worth(seen, rank)
    assert likely[0] > likely[2] > likely[1] > 0


def test_a_budget_that_makes_no_sense_is_refused():
    with pytest.raises(InvalidValue):
        SelectionSettings(2 * FIXED_BYTES - 1)
