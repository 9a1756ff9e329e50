"""Which pairs of nodes are worth a verification: those that share many similar descriptors.

The overlap of two nodes depends on these two alone, not on the rest of the fleet, so a table of overlaps can
grow node by node and the choice made from it does not depend on the order.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId

LEAST_OVERLAP = 3.0
"""Pairs whose nodes have less in common (see `overlap`) are not compared."""


Pair = tuple[NodeId, NodeId]


def overlap(
    rows: NDArray[np.int64], columns: NDArray[np.int64], squared: NDArray[Any], alike: float
) -> float:
    """How many landmarks two nodes seem to share, from all pairs of similar descriptors.

    Each descriptor counts once, with its best partner and by how near that is; the smaller of the two sides'
    sums makes it symmetric.

    Args:
        rows: (K,) descriptor of the first node.
        columns: (K,) descriptor of the other.
        squared: (K,) squared distances, all below alike^2.
        alike: distance at which a pair counts nothing.
    """
    weights = 1.0 - np.asarray(squared, dtype=np.float64) / alike**2
    sums = []
    for side in (rows, columns):
        best = np.zeros(int(side.max(initial=-1)) + 1)
        np.maximum.at(best, side, weights)
        sums.append(float(best.sum()))
    return min(sums)


ALIKE = 0.5
"""Distance of two decoded descriptors below which they may be the same landmark."""


MOST_PER_MAP = 4
"""Best pairs of one node with the nodes of any one map."""
LEAST_HOPS = 3
"""Nodes of one map that are fewer edges apart are neighbours, not loops."""
