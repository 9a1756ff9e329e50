"""Drift: which nodes of a merged map have come, were made anew, or lie elsewhere than they were last seen."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.pose import Array


class ChangedNodes:
    """Where nodes were when they were told last. What has moved by less adds up until it is told."""

    def __init__(self, moved: float, turned: float) -> None:
        """Nothing is known yet.

        Args:
            moved: m, by which a node moves before it is told again.
            turned: rad, the same.
        """
        self._moved, self._turned = moved, turned
        self._nodes: dict[NodeId, Node] = {}
        self._rows: dict[NodeId, int] = {}
        self._means: Array = np.zeros((0, 3))

    def told(self, nodes: Sequence[Node], means: Array) -> NDArray[np.bool_]:
        """(N,) which of these nodes have come, were made anew, or have moved; they are told herewith.

        Args:
            nodes: of one component.
            means: (N, 3) m, m, rad, where they are.
        """
        known = [self._nodes.get(node.id) is node for node in nodes]
        rows = np.array([self._rows.get(node.id, -1) for node in nodes], np.int64)
        off = np.abs(means - self._means[rows]) if len(self._means) else np.zeros_like(means)
        turns = np.minimum(off[:, 2], np.abs(math.tau - off[:, 2]))
        moved = (off[:, :2] >= self._moved).any(axis=1) | (turns >= self._turned)
        out: NDArray[np.bool_] = ~np.array(known, np.bool_) | (rows < 0) | moved
        for k in np.flatnonzero(out).tolist():
            self._nodes[nodes[k].id] = nodes[k]
        fresh = np.flatnonzero(rows < 0)
        for seat, k in enumerate(fresh.tolist(), len(self._means)):
            self._rows[nodes[k].id] = seat
        there = out & (rows >= 0)
        self._means[rows[there]] = means[there]
        self._means = np.concatenate([self._means, means[fresh]])
        return out

    def gone(self, components: Iterable[frozenset[NodeId]]) -> set[NodeId]:
        """Nodes that are in none of these components any more; they are forgotten."""
        out = set(self._rows).difference(*components)
        for node in out:
            # Its row stays: there are no more of them than there ever were nodes.
            del self._nodes[node], self._rows[node]
        return out
