"""The nearest landmarks without those that are hidden, of an index that knows nothing of that."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int64]
Bools = NDArray[np.bool_]
Found = tuple[NDArray[np.float32], Ids]
"""(N, k) squared distances, nearest first, and ids; infinite and -1 where there are fewer."""

Hidden = Callable[[Ids], Bools]
"""Which of some ids are not wanted. -1 may be either."""
Search = Callable[[Ids, int], Found]
"""Finds so many nearest landmarks of some of the features, whose numbers are given."""


def nearest_wanted(search: Search, features: int, k: int, hidden: Hidden, most: int) -> Found:
    """The k nearest landmarks that are not hidden.

    Twice as many are searched; for features that have too few wanted ones among them four times as many, and
    so on, as long as there are more.

    Args:
        search: finds the nearest, hidden ones among them.
        features: N, how many.
        k: landmarks wanted of each.
        hidden: which are not wanted.
        most: landmarks that a search finds at most, of all features together.
    """
    squared, ids = np.full((features, k), np.inf, np.float32), np.full((features, k), -1)
    left, count = np.arange(features), max(min(2 * k, most // max(features, 1)), k)
    while len(left):
        found_squared, found = search(left, count)
        wanted = (found >= 0) & ~hidden(found)
        first = np.argsort(~wanted, axis=1, kind="stable")[:, :k]
        kept = np.take_along_axis(wanted, first, axis=1)
        squared[left] = np.where(kept, np.take_along_axis(found_squared, first, axis=1), np.inf)
        ids[left] = np.where(kept, np.take_along_axis(found, first, axis=1), -1)
        left = left[~kept.all(axis=1) & (found[:, -1] >= 0)]
        more = min(4 * count, most // max(len(left), 1))
        if more <= count:
            break
        count = more
    return squared, ids
