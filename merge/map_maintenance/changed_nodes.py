"""Drift: which nodes of a merged map are new, were written again, or have moved since the last time."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array


class ChangedNodes:
    """Keeps the last reported pose of each node. Smaller motions add up until they are reported."""

    def __init__(self, moved: float, turned: float) -> None:
        """Nothing is known yet.

        Args:
            moved: m, least motion of a node that is reported.
            turned: rad, the same.
        """
        self._moved, self._turned = moved, turned
        self._nodes: dict[NodeId, Node] = {}
        self._rows: dict[NodeId, int] = {}
        self._means: Array = np.zeros((0, 3))

    def changed(self, nodes: Sequence[Node], means: Array) -> NDArray[np.bool_]:
        """(N,) which of these nodes are new, were written again, or have moved since they were last reported.

        Args:
            nodes: of one component.
            means: (N, 3) m, m, rad, where they are.
        """
        unchanged = [self._nodes.get(node.id) is node for node in nodes]
        rows = np.array([self._rows.get(node.id, -1) for node in nodes], np.int64)
        off = np.abs(means - self._means[rows]) if len(self._means) else np.zeros_like(means)
        turns = np.minimum(off[:, 2], np.abs(math.tau - off[:, 2]))
        moved = (off[:, :2] >= self._moved).any(axis=1) | (turns >= self._turned)
        out: NDArray[np.bool_] = ~np.array(unchanged, np.bool_) | (rows < 0) | moved
        for k in np.flatnonzero(out).tolist():
            self._nodes[nodes[k].id] = nodes[k]
        fresh = np.flatnonzero(rows < 0)
        for seat, k in enumerate(fresh.tolist(), len(self._means)):
            self._rows[nodes[k].id] = seat
        with_previous = out & (rows >= 0)
        self._means[rows[with_previous]] = means[with_previous]
        self._means = np.concatenate([self._means, means[fresh]])
        return out

    def removed(self, components: Iterable[frozenset[NodeId]]) -> set[NodeId]:
        """Nodes that are in none of these components any more; they are forgotten."""
        out = set(self._rows).difference(*components)
        for node in out:
            del self._nodes[node], self._rows[node]
        if out:
            self._means = self._means[list(self._rows.values())]
            self._rows = {node: row for row, node in enumerate(self._rows)}
        return out
