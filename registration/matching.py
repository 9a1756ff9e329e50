"""Which features of two images look alike.

A one-way ratio test lets many features of one image choose the same feature of the other, which on frames
with little texture makes dozens of wrong matches that agree with some geometry. So a match has to be the best
in both directions, and distinctly better than the second best in both.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.descriptor import rounding_noise
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.landmark_tables import landmark_tables
from mapweave.hybridmap.node import CODE_BYTES


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


def squared_distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, D) and (M, D) -> (N, M) squared Euclidean distances, by one matrix product.

    Whole numbers stay exact as long as no square is beyond 2^24.
    """
    out: NDArray[np.float32] = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)[None] - 2 * (a @ b.T)
    np.maximum(out, 0, out=out)
    return out


def match_vectors(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    settings: MatchSettings | None = None,
    noise: float = 0.0,
) -> NDArray[np.int64]:
    """Match descriptors that are already decoded, as `match` does.

    Args:
        a: (N, D).
        b: (M, D).
        settings: when two descriptors are taken for the same.
        noise: what rounding has added to every squared distance on average; taken off again, so that the
            ratio is that of the distances before rounding.
    """
    return _mutual(squared_distances(a, b) - np.float32(noise), settings or MatchSettings())


def _mutual(squared: NDArray[np.float32], s: MatchSettings) -> NDArray[np.int64]:
    """Pairs that are each other's nearest and distinctly so, of (N, M) squared distances."""
    if squared.size == 0:
        return np.zeros((0, 2), np.int64)
    (best_in_b, best, second), (best_in_a, _, second_in_a) = two_nearest(squared), two_nearest(squared.T)
    mutual = best_in_a[best_in_b] == np.arange(len(best))
    distinct = best < s.ratio**2 * np.minimum(second, second_in_a[best_in_b])
    kept = np.flatnonzero(mutual & distinct & (best <= s.most_distance**2))
    kept = kept[np.argsort(best[kept], kind="stable")]
    return np.stack([kept, best_in_b[kept]], axis=1).astype(np.int64)


def two_nearest(
    table: NDArray[np.float32],
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """The nearest of each row of an (N, M) table of distances, N and M at least 1.

    Returns:
        (N,) which, of equals the first; its distance; and the second nearest's, infinite if there is none.
    """
    rows = np.arange(len(table))
    which = table.argmin(axis=1)
    others = table.copy()
    others[rows, which] = np.inf
    return which, table[rows, which], others.min(axis=1)


def match(
    codes_a: NDArray[np.uint8], codes_b: NDArray[np.uint8], settings: MatchSettings | None = None
) -> NDArray[np.int64]:
    """Match compact descriptors: mutual nearest neighbours that pass the ratio test both ways.

    Args:
        codes_a: (N, 32) uint8.
        codes_b: (M, 32) uint8.
        settings: when two descriptors are taken for the same.

    Returns:
        (K, 2) int64, indices in a and in b, best first; no index occurs twice in a column.

    Raises:
        InvalidValue: the input is not (N, 32) bytes.
    """
    for codes in (codes_a, codes_b):
        if codes.ndim != 2 or codes.shape[1] != CODE_BYTES or codes.dtype != np.uint8:
            raise InvalidValue(f"codes must be (N, {CODE_BYTES}) uint8, not {codes.shape} {codes.dtype}")
    steps = squared_distances(codes_a.astype(np.float32), codes_b.astype(np.float32))
    squared = steps * np.float32(landmark_tables().step ** 2)
    return _mutual(squared - np.float32(rounding_noise()), settings or MatchSettings())
