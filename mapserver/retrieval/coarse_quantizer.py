"""Means of means of compact descriptors: k-means twice, so that finding the nearest takes two small searches.

A landmark belongs to the nearest mean of the nearest family. A question asks for the several nearest means of
the nearest few families.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.landmark_tables import DIMENSIONS

SEED = 1234
"""Of the means' starts: the same landmarks make the same means."""
SAMPLE = 40
"""Landmarks a mean from which it is learned."""
ROUNDS = 8
"""Of k-means."""
FAMILIES = 8
"""Among whose means a question finds the nearest."""
BLOCK = 1 << 17
"""Codes that are widened to floats at once."""
FEW = 2048
"""Fewer vectors than these are not parted by families."""
FAR = 1e6
"""Coordinates of the mean of nothing."""

Codes = NDArray[np.uint8]
Ids = NDArray[np.int64]
Vectors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CoarseQuantizer:
    """Means in families.

    Attributes:
        heads: (F, 32) float32, the mean of each family.
        means: (M, 32) float32, by families.
        starts: (F + 1,) where in `means` a family begins, and where the last one ends.
    """

    heads: Vectors
    means: Vectors
    starts: Ids

    def __len__(self) -> int:
        """How many means."""
        return len(self.means)

    @classmethod
    def learn(cls, sample: Codes, count: int) -> CoarseQuantizer:
        """About so many means of (N, 32) codes, in families about the root of that many."""
        heads = 1 << round(math.log2(count) / 2)
        few = sample[:: max(len(sample) // (4 * SAMPLE * heads), 1)]
        above = _learned(few.astype(np.float32), heads)
        family = np.concatenate([nearest(part, above) for part in widened(sample)])
        below = [
            _learned(sample[family == k].astype(np.float32), max(count // heads, 1))
            for k in range(len(above))
        ]  # fmt: skip
        starts = np.concatenate([[0], np.cumsum([len(cell) for cell in below])])
        return cls(above, np.concatenate(below), starts.astype(np.int64))

    def nearest(self, vectors: Vectors) -> Ids:
        """(N,) which mean each of (N, 32) vectors belongs to."""
        if len(vectors) < FEW:
            # The same two searches; family by family costs a call each.
            cells: Ids = self.searched.search(vectors, 1, params=probing(1))[1][:, 0]
            return cells
        family = nearest(vectors, self.heads)
        order = np.argsort(family, kind="stable")
        out = np.empty(len(vectors), np.int64)
        for rows in np.split(order, np.flatnonzero(np.diff(family[order])) + 1):
            if len(rows):
                start, end = self.starts[family[rows[0]] :][:2]
                out[rows] = start + nearest(vectors[rows], self.means[start:end])
        return out

    @cached_property
    def searched(self) -> Any:
        """A FAISS index that finds the several nearest means of FAMILIES families."""
        import faiss

        heads = faiss.IndexFlatL2(DIMENSIONS)
        heads.add(self.heads)
        index = faiss.IndexIVFFlat(heads, DIMENSIONS, len(self.heads))
        index.is_trained = True
        numbers = np.arange(len(self.means))
        family = np.repeat(np.arange(len(self.heads)), np.diff(self.starts))
        index.add_core(
            len(numbers), faiss.swig_ptr(self.means), faiss.swig_ptr(numbers), faiss.swig_ptr(family), None
        )
        index.nprobe = min(FAMILIES, len(self.heads))
        return index


def probing(count: int) -> Any:
    """Search so many lists of an inverted file."""
    import faiss

    parameters: Any = faiss.SearchParametersIVF()
    parameters.nprobe = count
    return parameters


def widened(codes: Codes) -> Iterator[Vectors]:
    """(N, 32) codes as floats, block by block."""
    for start in range(0, max(len(codes), 1), BLOCK):
        yield codes[start : start + BLOCK].astype(np.float32)


def nearest(vectors: Vectors, means: Vectors) -> Ids:
    """(N,) which of (M, 32) means is nearest to each of (N, 32) vectors."""
    import faiss

    if not len(vectors):
        return np.zeros(0, np.int64)
    cells: Ids = faiss.knn(vectors, means, 1)[1][:, 0]
    return cells


def _learned(sample: Vectors, count: int) -> Vectors:
    """(at most count, 32) means of a sample."""
    import faiss

    if len(sample) <= count:
        return sample if len(sample) else np.full((1, DIMENSIONS), FAR, np.float32)
    means = faiss.Kmeans(DIMENSIONS, count, niter=ROUNDS, seed=SEED, min_points_per_centroid=1)
    means.train(sample)
    return np.asarray(means.centroids, np.float32).reshape(-1, DIMENSIONS)
