"""Compact descriptors of a large fleet in cells of the descriptors' space, of which a few are searched.

FAISS's inverted file, a byte a coordinate: whole steps are kept as they are in the nodes, so distances are
exact, and only cells that are not searched can hide something. The cells' middles are means of means (k-means
twice), which sorts a landmark in with two small matrix products instead of one large one.
"""

from __future__ import annotations

import math
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from hybridmap.landmark_tables import DIMENSIONS, landmark_tables

SEED = 1234
"""Of the means' starts: the same landmarks make the same cells."""
SAMPLE = 40
"""Landmarks a cell from which the cells are learned."""
ROUNDS = 8
"""Of k-means."""
BLOCK = 1 << 15
"""Landmarks that are sorted in at once."""

Codes = NDArray[np.uint8]
Ids = NDArray[np.int64]
Vectors = NDArray[np.float32]


class Cells:
    """Codes with ids, by cells that were learned once."""

    def __init__(self, codes: Codes, ids: Ids, count: int) -> None:
        """Learn cells from landmarks, and sort these in.

        Args:
            codes: (N, 32) of all landmarks that there are.
            ids: (N,).
            count: of cells, about.
        """
        sample = codes[:: max(len(codes) // (SAMPLE * count), 1)].astype(np.float32)
        above = 1 << round(math.log2(count) / 2)
        self._above = _means(sample, above)
        nearest = _nearest(sample, self._above)
        below = [_means(sample[nearest == k], max(count // above, 1)) for k in range(len(self._above))]
        self._starts = np.concatenate([[0], np.cumsum([len(one) for one in below])])
        self._below = below
        quantiser = faiss.IndexFlatL2(DIMENSIONS)
        quantiser.add(np.concatenate(below))
        self._index = faiss.IndexIVFScalarQuantizer(
            quantiser, DIMENSIONS, quantiser.ntotal, faiss.ScalarQuantizer.QT_8bit_direct,
            faiss.METRIC_L2, False,
        )  # fmt: skip
        self._index.train(sample[:1])
        self.add(codes, ids)

    def __len__(self) -> int:
        """How many landmarks."""
        return int(self._index.ntotal)

    def add(self, codes: Codes, ids: Ids) -> None:
        """Sort (N, 32) codes in."""
        for start in range(0, len(codes), BLOCK):
            vectors = codes[start : start + BLOCK].astype(np.float32)
            numbers = np.ascontiguousarray(ids[start : start + BLOCK])
            cells = self._cells(vectors)
            self._index.add_core(
                len(vectors), faiss.swig_ptr(vectors), faiss.swig_ptr(numbers), faiss.swig_ptr(cells), None
            )

    def remove(self, first: int, last: int) -> None:
        """Forget the ids from first to last, that one left out."""
        self._index.remove_ids(faiss.IDSelectorRange(first, last))

    def nearest(self, codes: Codes, k: int, probes: int) -> tuple[Vectors, Ids]:
        """The k nearest landmarks in the nearest cells.

        Args:
            codes: (N, 32).
            k: at most.
            probes: cells to search.

        Returns:
            (N, k) squared distances of decoded descriptors, and ids; -1 where there are fewer.
        """
        self._index.nprobe = min(probes, self._index.nlist)
        squared, ids = self._index.search(codes.astype(np.float32), k)
        return squared * _step2(), ids

    def within(self, codes: Codes, reach: float, probes: int) -> tuple[Ids, Vectors, Ids]:
        """All landmarks in the nearest cells within a distance of decoded descriptors.

        Returns:
            (M,) row of the code, squared distance, id.
        """
        self._index.nprobe = min(probes, self._index.nlist)
        limits, squared, ids = self._index.range_search(codes.astype(np.float32), reach**2 / _step2())
        rows = np.repeat(np.arange(len(codes)), np.diff(limits.astype(np.int64)))
        return rows, squared * _step2(), ids

    def contents(self) -> tuple[Codes, Ids]:
        """All codes (N, 32) and ids (N,), in the order of their ids."""
        lists: Any = self._index.invlists
        codes, ids = [np.zeros((0, DIMENSIONS), np.uint8)], [np.zeros(0, np.int64)]
        for k in range(self._index.nlist):
            n = lists.list_size(k)
            if n:
                codes.append(faiss.rev_swig_ptr(lists.get_codes(k), n * DIMENSIONS).reshape(n, -1).copy())
                ids.append(faiss.rev_swig_ptr(lists.get_ids(k), n).copy())
        numbers = np.concatenate(ids)
        order = np.argsort(numbers, kind="stable")
        return np.concatenate(codes)[order], numbers[order]

    def _cells(self, vectors: Vectors) -> Ids:
        """(N,) the cell of each: the nearest below the nearest above."""
        above = _nearest(vectors, self._above)
        order = np.argsort(above, kind="stable")
        out = np.empty(len(vectors), np.int64)
        for rows in np.split(order, np.flatnonzero(np.diff(above[order])) + 1):
            if len(rows):
                k = int(above[rows[0]])
                out[rows] = self._starts[k] + _nearest(vectors[rows], self._below[k])
        return out


def _means(sample: Vectors, count: int) -> Vectors:
    """(at most count, 32) means of a sample."""
    if len(sample) <= count:
        return sample.copy() if len(sample) else np.full((1, DIMENSIONS), 1e6, np.float32)
    means = faiss.Kmeans(DIMENSIONS, count, niter=ROUNDS, seed=SEED, min_points_per_centroid=1)
    means.train(np.ascontiguousarray(sample))
    return np.asarray(means.centroids, np.float32).reshape(-1, DIMENSIONS)


def _nearest(vectors: Vectors, means: Vectors) -> Ids:
    """(N,) which mean is nearest to each vector."""
    out: Ids = ((means * means).sum(axis=1) - 2 * (vectors @ means.T)).argmin(axis=1)
    return out


def _step2() -> Any:
    """What a squared distance of codes is worth."""
    return np.float32(landmark_tables().step ** 2)
