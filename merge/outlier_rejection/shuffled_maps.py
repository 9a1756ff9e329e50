"""Shuffled maps: true views of places that others know, in an arrangement that no other map has.

A second place that looks the same looks the same from several nodes, and they agree how the two places lie to
each other. In a shuffled map each node shows a place of its own, and no two agree.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.merge.outlier_rejection.bent_maps import nearly_there
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link

LEAST_PLACED = 4
"""Nodes of a map whose place two links or more tell."""
MOST_IN_COMPANY = 0.5
"""Share of these nodes with which another one agrees."""


def is_shuffled(links: Sequence[Link], placed: Fragment, fixed: Fragment) -> bool:
    """Whether most nodes are where no other node's links have them.

    Args:
        links: from `placed` to `fixed`. Those of one node agree.
        placed: piece of map.
        fixed: piece of map.
    """
    confirmed = in_company(links, placed, fixed)
    return len(confirmed) >= LEAST_PLACED and float(confirmed.mean()) < MOST_IN_COMPANY


def in_company(links: Sequence[Link], placed: Fragment, fixed: Fragment) -> NDArray[np.bool_]:
    """(N,) for each node that is placed by two links or more: whether another one agrees with it."""
    own: dict[NodeId, list[Link]] = {}
    for link in links:
        own.setdefault(link.a, []).append(link)
    best = [max(some, key=lambda link: link.weight) for some in own.values() if len(some) > 1]
    if not best:
        return np.zeros(0, np.bool_)
    agree = nearly_there(best, placed, fixed)
    np.fill_diagonal(agree, False)
    return np.asarray((agree | agree.T).any(axis=1))
