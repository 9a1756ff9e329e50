"""Voting: from similar landmarks to similar nodes, for candidates of a view and overlaps of a node."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.mapserver.retrieval.similar_landmarks import comparable, similar

Whole = NDArray[np.int64]
Real = NDArray[np.float64]


def votes(squared: NDArray[np.float32], slots: Whole, reach: float) -> tuple[Whole, Real]:
    """Votes of the features of a view.

    Each feature votes for the nodes of its nearest descriptors, by nearness and once a node. Its weight is
    divided by the root of the number of nodes it votes for, as rare words weigh more in a text: a feature
    that half the fleet sees is little evidence.

    Args:
        squared: (N, k) squared distances of N features' nearest landmarks, nearest first.
        slots: (N, k) the nodes of the landmarks; below 0 for none.
        reach: distance at which a vote counts nothing.

    Returns:
        (M,) slots, rising, and (M,) scores above 0.
    """
    weights = np.where(slots >= 0, 1.0 - squared.astype(np.float64) / reach**2, 0.0)
    feature, place = np.nonzero(weights > 0)
    owners = slots[feature, place]
    # The nearest descriptor comes first, so the first vote of a feature for a node is its best.
    _, first = np.unique(feature * (owners.max(initial=0) + 1) + owners, return_index=True)
    feature, owners, given = feature[first], owners[first], weights[feature[first], place[first]]
    given /= np.sqrt(np.bincount(feature, minlength=len(squared)))[feature]
    nodes, which = np.unique(owners, return_inverse=True)
    scores: NDArray[Any] = np.bincount(which, given, minlength=len(nodes))
    return nodes, scores.astype(np.float64)


def overlaps(
    rows: Whole, columns: Whole, squared: NDArray[Any], slots: Whole, alike: float, least: float
) -> tuple[Whole, Real]:
    """How many landmarks a node seems to share with each of many others.

    Each landmark counts once, with its best partner and by how near that is; the smaller of the two sides'
    sums makes it symmetric.

    Args:
        rows: (K,) landmark of the node.
        columns: (K,) similar landmark of the other.
        squared: (K,) squared distances, all below alike^2.
        slots: (K,) which other.
        alike: distance at which a pair counts nothing.
        least: overlap from which on it is returned.

    Returns:
        (M,) slots, rising, and (M,) overlaps of at least `least`.
    """
    nodes, which, hits = np.unique(slots, return_inverse=True, return_counts=True)
    # A node with fewer hits than the least overlap cannot reach it.
    enough = hits[which] >= least
    rows, columns, which = rows[enough], columns[enough], which[enough]
    weights = 1.0 - np.asarray(squared[enough], np.float64) / alike**2
    sums = np.minimum(*(_best(which, side, weights, len(nodes)) for side in (rows, columns)))
    kept = np.flatnonzero(sums >= least)
    return nodes[kept], sums[kept]


def pair_overlaps(
    codes: NDArray[np.uint8], others: Sequence[NDArray[np.uint8]], alike: float, least: float
) -> list[float]:
    """The same of a node's (N, 32) codes with several others' (M, 32): 0 where it is below the least."""
    values = np.zeros(len(others))
    if others:
        columns, rows, squared = similar(comparable(np.concatenate(others)), codes, alike)
        owners = np.repeat(np.arange(len(others)), [len(other) for other in others])
        found, enough = overlaps(rows, columns, squared, owners[columns], alike, least)
        values[found] = enough
    return [float(value) for value in values]


def _best(which: Whole, side: Whole, weights: Real, count: int) -> Real:
    """(count,) sums, over the landmarks of one side, of the best weight of each."""
    if not len(which):
        return np.zeros(count)
    keys = which * (int(side.max()) + 1) + side
    order = np.argsort(keys, kind="stable")
    starts = np.concatenate([[0], np.flatnonzero(np.diff(keys[order])) + 1])
    best = np.maximum.reduceat(weights[order], starts)
    sums: NDArray[Any] = np.bincount(which[order[starts]], best, minlength=count)
    return sums.astype(np.float64)
