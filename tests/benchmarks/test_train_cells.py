"""The learning of cells, on descriptors that are drawn."""

import numpy as np
import pytest

from benchmarks.train_cells import benchmark
from mapweave.hybridmap.descriptor import quantise
from mapweave.mapserver.retrieval.coarse_quantizer import CoarseQuantizer, coarse_quantizers
from synthetic.world import random_vectors


def codes_of(count: int, seed: int) -> benchmark.Codes:
    """(count, 32), scattered about sixteen descriptors."""
    rng = np.random.default_rng(seed)
    centres = random_vectors(16, np.random.default_rng(1))
    return quantise(centres[rng.integers(0, 16, count)] + rng.normal(0, 0.03, (count, 32)))


def test_the_same_examples_make_the_same_cells_and_these_fit_other_examples():
    cells, again = (benchmark.learned(codes_of(4000, 2), 4) for _ in range(2))
    assert np.array_equal(cells.heads, again.heads) and np.array_equal(cells.centres, again.centres)
    assert benchmark.imbalance(cells, codes_of(2000, 3)) < 2.5
    # Of one descriptor alone all landmarks share a cell.
    assert benchmark.imbalance(cells, np.repeat(codes_of(1, 4), 50, axis=0)) == pytest.approx(16)


def test_what_is_stored_is_what_is_read(monkeypatch, tmp_path):
    shipped = {len(cells.heads): cells for cells in coarse_quantizers()}
    monkeypatch.setattr(benchmark.retrieval, "__path__", [str(tmp_path)])
    path = benchmark.store(shipped)
    with np.load(path) as stored:
        for families, cells in shipped.items():
            read = CoarseQuantizer(stored[f"heads{families}"], stored[f"centres{families}"])
            assert np.array_equal(read.heads, cells.heads) and np.array_equal(read.centres, cells.centres)
