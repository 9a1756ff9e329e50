"""Which features of two images look alike.

A one-way ratio test lets many features of one image choose the same feature of the other, which on frames
with little texture makes dozens of wrong matches that agree with some geometry. So a match has to be the best
in both directions, and distinctly better than the second best in both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.descriptor import decode, rounding_noise


@dataclass(frozen=True)
class MatchSettings:
    """When two descriptors are taken for the same.

    Attributes:
        ratio: largest ratio of the best distance to the second best, in each direction.
        most_distance: largest distance of two decoded descriptors; RootSIFT has unit length, so unrelated
            descriptors are about 0.9 apart.
    """

    ratio: float = 0.85
    most_distance: float = 0.75


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of features, best first.

    Attributes:
        pairs: (K, 2) int64, indices in a and in b; no index occurs twice in a column.
        distances: (K,) float32, between the descriptors; 0 where rounding could explain all of it.
    """

    pairs: NDArray[np.int64]
    distances: NDArray[np.float32]

    def __len__(self) -> int:
        """How many."""
        return len(self.pairs)


def squared_distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, D) and (M, D) -> (N, M) squared Euclidean distances, by one matrix product."""
    out: NDArray[np.float32] = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)[None] - 2 * (a @ b.T)
    np.maximum(out, 0, out=out)
    return out


def match_vectors(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    settings: MatchSettings | None = None,
    noise: float = 0.0,
) -> Matches:
    """Match descriptors that are already decoded.

    Args:
        a: (N, D).
        b: (M, D).
        settings: when two descriptors are taken for the same.
        noise: what rounding has added to every squared distance on average; taken off again, so that the
            ratio is that of the distances before rounding.
    """
    s = settings or MatchSettings()
    if len(a) == 0 or len(b) == 0:
        return Matches(np.zeros((0, 2), np.int64), np.zeros(0, np.float32))
    squared = squared_distances(a, b) - np.float32(noise)
    best_in_b = squared.argmin(axis=1)
    rows = np.arange(len(a))
    best = squared[rows, best_in_b]
    mutual = squared.argmin(axis=0)[best_in_b] == rows
    distinct = (best < s.ratio**2 * _second(squared, axis=1)) & (
        best < s.ratio**2 * _second(squared, axis=0)[best_in_b]
    )
    kept = np.flatnonzero(mutual & distinct & (best <= s.most_distance**2))
    kept = kept[np.argsort(best[kept], kind="stable")]
    return Matches(
        np.stack([kept, best_in_b[kept]], axis=1).astype(np.int64),
        np.sqrt(np.maximum(best[kept], 0)).astype(np.float32),
    )


def _second(squared: NDArray[np.float32], axis: int) -> NDArray[Any]:
    """Second smallest along an axis; infinite where there is only one."""
    if squared.shape[axis] < 2:
        return np.full(squared.shape[1 - axis], np.inf, np.float32)
    second: NDArray[Any] = np.take(np.partition(squared, 1, axis=axis), 1, axis=axis)
    return second


def match(
    codes_a: NDArray[np.uint8], codes_b: NDArray[np.uint8], settings: MatchSettings | None = None
) -> NDArray[np.int64]:
    """Match compact descriptors: mutual nearest neighbours that pass the ratio test both ways.

    Args:
        codes_a: (N, 32) uint8.
        codes_b: (M, 32) uint8.
        settings: when two descriptors are taken for the same.

    Returns:
        (K, 2) int64, indices in a and in b, best first; `match_vectors` gives the distances as well.
    """
    return match_vectors(decode(codes_a), decode(codes_b), settings, rounding_noise()).pairs
