"""Cells of descriptors against brute force."""

import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave.hybridmap.descriptor import decode, quantise
from mapweave.mapserver.retrieval.coarse_quantizer import coarse_quantizers
from mapweave.mapserver.retrieval.inverted_file import InvertedFile
from mapweave.registration.matching import squared_distances
from synthetic.world import random_vectors

Codes = NDArray[np.uint8]
Ids = NDArray[np.int64]


@pytest.fixture(scope="module")
def landmarks() -> tuple[Codes, Ids]:
    """Three thousand that are seen again and again, with ids in no order."""
    rng = np.random.default_rng(1)
    seen = random_vectors(600, rng)[rng.integers(0, 600, 3000)]
    codes = quantise(seen + rng.normal(0, 0.05, seen.shape))
    return codes, rng.permutation(50_000)[: len(codes)].astype(np.int64)


def filled(codes: Codes, ids: Ids) -> InvertedFile:
    cells = InvertedFile(coarse_quantizers()[0])
    cells.add(codes, ids)
    return cells


def contents(cells: InvertedFile) -> tuple[Codes, Ids]:
    """In the order of the ids, read in several blocks."""
    blocks = list(cells.blocks(500))
    assert len(blocks) > 1
    codes, ids = (np.concatenate(column) for column in zip(*blocks, strict=True))
    order = np.argsort(ids)
    return codes[order], ids[order]


def asked(codes: Codes, n: int, seed: int) -> Codes:
    rng = np.random.default_rng(seed)
    vectors = decode(codes[rng.integers(0, len(codes), n)])
    return quantise(vectors + rng.normal(0, 0.04, vectors.shape))


def test_all_cells_are_brute_force(landmarks: tuple[Codes, Ids]):
    codes, ids = landmarks
    cells, questions = filled(codes, ids), asked(codes, 50, 2)
    every = squared_distances(decode(questions), decode(codes))
    squared, result = cells.nearest(questions, 10, probes=1000)
    assert np.allclose(squared, np.sort(every, axis=1)[:, :10], atol=1e-4)
    # Equal distances may come in any order.
    column = {int(number): k for k, number in enumerate(ids)}
    again = np.array([[every[r, column[int(number)]] for number in row] for r, row in enumerate(result)])
    assert np.allclose(again, squared, atol=1e-4)


def test_hidden_landmarks_are_as_if_they_were_not_there(landmarks: tuple[Codes, Ids]):
    codes, ids = landmarks
    questions, quantizer = asked(codes, 50, 2), coarse_quantizers()[0]
    # Of each landmark that is wanted there are forty that are not.
    wanted, cells = InvertedFile(quantizer), InvertedFile(quantizer)
    wanted.add(codes[:200], ids[:200])
    cells.add(codes[:200], ids[:200])
    cells.add(np.repeat(codes[:200], 40, axis=0), 100_000 + np.arange(8000))
    squared, result = cells.nearest(questions, 10, 4, lambda found: found >= 100_000)
    expected_squared, expected = wanted.nearest(questions, 10, 4)
    assert np.array_equal(np.sort(result), np.sort(expected))
    there = expected >= 0
    assert np.array_equal(squared[there], expected_squared[there]) and np.isinf(squared[~there]).all()


def test_a_few_cells_find_nearly_all_that_was_seen_before(landmarks: tuple[Codes, Ids]):
    codes, ids = landmarks
    cells, questions = filled(codes, ids), asked(codes, 300, 3)
    every = squared_distances(decode(questions), decode(codes))
    squared, _ = cells.nearest(questions, 1, probes=16)
    assert np.mean(squared[:, 0] < every.min(axis=1) + 1e-4) > 0.9


def test_removed_entries_are_gone_and_the_rest_is_kept(landmarks: tuple[Codes, Ids]):
    codes, ids = landmarks
    cells = filled(codes[:2000], ids[:2000])
    cells.add(codes[2000:], ids[2000:])
    cells.remove(10_000, 20_000)
    left = (ids < 10_000) | (ids >= 20_000)
    kept_codes, kept_ids = contents(cells)
    order = np.argsort(ids[left])
    assert np.array_equal(kept_ids, ids[left][order]) and np.array_equal(kept_codes, codes[left][order])
    assert len(cells) == left.sum()


def test_the_same_landmarks_make_the_same_cells(landmarks: tuple[Codes, Ids]):
    codes, ids = landmarks
    questions = asked(codes, 100, 4)
    a, b = (filled(codes, ids).nearest(questions, 5, probes=2) for _ in range(2))
    assert np.array_equal(a[1], b[1]) and np.array_equal(a[0], b[0])


def test_fewer_landmarks_than_cells():
    codes = quantise(random_vectors(3, np.random.default_rng(5)))
    cells = filled(codes, np.arange(3))
    squared, ids = cells.nearest(codes, 4, probes=256)
    assert ids[:, 0].tolist() == [0, 1, 2] and np.allclose(squared[:, 0], 0.0) and (ids[:, 3] == -1).all()


@pytest.mark.parametrize("named", ["all", "others"])
def test_forgetting_a_row_equals_forgetting_its_node(landmarks: tuple[Codes, Ids], named: str):
    codes, ids = landmarks
    ids = np.argsort(np.argsort(ids))
    cells, searched = filled(codes, ids), filled(codes, ids)
    lists = cells._index
    for first in (0, 700, 2900):
        gone = codes[(ids >= first) & (ids < first + 100)]
        # Wrong assumptions about the codes make it slow, not wrong.
        cells.remove(first, first + 100, gone[::-1] if named == "all" else 63 - gone)
        searched.remove(first, first + 100)
    assert len(cells) == len(searched) == 2700
    for a, b in zip(contents(cells), contents(searched), strict=True):
        assert np.array_equal(a, b)
    assert sum(lists.invlists.list_size(k) for k in range(lists.nlist)) == 2700
    questions = asked(codes, 50, 4)
    for a, b in zip(cells.nearest(questions, 8, 256), searched.nearest(questions, 8, 256), strict=True):
        assert np.array_equal(np.sort(a, axis=1), np.sort(b, axis=1))
    cells.add(codes[:100], np.arange(10_000, 10_100))
    assert len(cells) == 2800
