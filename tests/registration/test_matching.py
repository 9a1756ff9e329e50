"""Matching against a plain double loop."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.descriptor import decode
from mapweave.registration.matching import MatchSettings, match, match_vectors, squared_distances, two_nearest


def brute_force(a: np.ndarray, b: np.ndarray, s: MatchSettings, noise: float) -> set[tuple[int, int]]:
    distances = np.array([[np.sqrt(max(0.0, np.sum((x - y) ** 2) - noise)) for y in b] for x in a])
    collected = set()
    for i in range(len(a)):
        j = int(distances[i].argmin())
        if int(distances[:, j].argmin()) != i or distances[i, j] > s.most_distance:
            continue
        others = [*np.delete(distances[i], j), *np.delete(distances[:, j], i)]
        if all(distances[i, j] < s.ratio * other for other in others):
            collected.add((i, j))
    return collected


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 10**6), st.sampled_from([0.0, 0.006]))
def test_against_brute_force(n: int, m: int, seed: int, noise: float):
    rng = np.random.default_rng(seed)
    a = rng.normal(0, 0.12, (n, 32)).astype(np.float32)
    b = np.concatenate([a[: n // 2] + rng.normal(0, 0.04, (n // 2, 32)), rng.normal(0, 0.12, (m, 32))])
    s = MatchSettings()
    b = b.astype(np.float32)
    pairs = match_vectors(a, b, s, noise)
    assert {(int(i), int(j)) for i, j in pairs} == brute_force(a, b, s, noise)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.integers(1, 20))
def test_nearest_and_second_are_exact(seed: int, n: int, m: int):
    rng = np.random.default_rng(seed)
    a, b = random_codes(n, rng), random_codes(m, rng)
    exact = ((a[:, None].astype(int) - b[None].astype(int)) ** 2).sum(axis=2)
    assert (squared_distances(a.astype(np.float32), b.astype(np.float32)) == exact).all()
    table = rng.integers(0, 5, (n, m)).astype(np.float32)  # with equals
    before = table.copy()
    best, least, second = two_nearest(table)
    ordered = np.sort(np.column_stack([table, np.full(n, np.inf)]), axis=1)
    assert (best == table.argmin(axis=1)).all()
    assert (least == ordered[:, 0]).all() and (second == ordered[:, 1]).all()
    assert (table == before).all()


def random_codes(n: int, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 64, (n, 32), dtype=np.uint8)


def test_no_feature_is_used_twice_and_the_best_come_first():
    """The trap of a one-way test: everything in a low-texture image matches the same few features."""
    rng = np.random.default_rng(3)
    one = random_codes(1, rng)
    crowd = np.repeat(one, 40, axis=0)
    crowd[:, 0] = rng.integers(0, 64, 40)
    other = np.concatenate([one, random_codes(30, rng)])
    assert len(match(crowd, other)) <= 1
    codes = random_codes(60, rng)
    a = decode(codes)
    noise = rng.normal(0, 1, (60, 32)) * rng.uniform(0.005, 0.08, (60, 1))
    b = (decode(codes[::-1].copy()) + noise).astype(np.float32)
    pairs = match_vectors(a, b)
    assert len(pairs) == len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == 60
    assert (np.diff(np.linalg.norm(a[pairs[:, 0]] - b[pairs[:, 1]], axis=1)) > -1e-3).all()


def test_nothing_matches_nothing():
    none, some = np.zeros((0, 32), np.uint8), np.zeros((4, 32), np.uint8)
    for a, b in ((none, some), (some, none), (none, none)):
        assert match(a, b).shape == (0, 2)
        assert match(a, b).dtype == np.int64


def test_a_single_candidate_is_judged_by_distance_alone():
    codes = np.arange(64, dtype=np.uint8).reshape(2, 32)
    assert match(codes[:1], codes[:1]).tolist() == [[0, 0]]
