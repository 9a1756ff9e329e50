"""A solved component of many nodes: covariances are worked out around where they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from hybridmap.node import NodeId
from hybridmap.pose import Array
from hybridmap.pose_arrays import PoseGaussians, adjoints, compose_poses, inverse_poses
from merge.incremental_factors import Factors, Rows
from merge.posegraph import ANCHOR_SIGMA, PoseGraph

NEARBY = 300
"""Nodes around a pair whose measurements say how the two stand to each other; more, if none joins them."""
PAIRS_AT_ONCE = 64


class WideGraph(PoseGraph):
    """A pose graph of a large component; its nodes are in the order of their maps and ids.

    How two nodes stand to each other is known by the measurements around them. What lies further away would
    make it a little more certain and is left out, so covariances are a little too large, never too small.
    """

    factors: Factors

    def __init__(
        self, anchor: NodeId, nodes: tuple[NodeId, ...], means: Array, factors: Factors, huber: float
    ) -> None:
        """Take a solution.

        Args:
            anchor: the node that is held.
            nodes: of one connected component.
            means: (N, 3) m, m, rad.
            factors: between rows of the nodes.
            huber: normalised residual from which a robust measurement pulled no harder.
        """
        values = {"anchor": anchor, "nodes": nodes, "means": means, "factors": factors, "huber": huber}
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @cached_property
    def information(self) -> sparse.csc_matrix:
        """(3N, 3N) sparse, of the right perturbations of all nodes, anchor held."""
        held = np.zeros((len(self.nodes), 3))
        held[self.rows[self.anchor]] = ANCHOR_SIGMA**-2
        whole = self.factors.system(self.means, self.huber)[0]
        return sparse.csc_matrix(whole + sparse.diags(held.ravel()))

    def relative(self, starts: Sequence[NodeId], ends: Sequence[NodeId]) -> PoseGaussians:
        """Postures `start_from_end` of K pairs, by what was measured around them.

        Raises:
            ValueError: nothing joins a pair: this is no component.
        """
        i, j = self.index(starts), self.index(ends)
        means = compose_poses(inverse_poses(self.means[i]), self.means[j])
        covariances = np.zeros((len(i), 3, 3))
        left, wanted = np.flatnonzero(i != j), NEARBY
        while len(left):
            rows = self.factors.around(np.array([i[left[0]], j[left[0]]]), wanted, len(self.nodes))
            order = np.full(len(self.nodes), len(rows))
            order[rows] = np.arange(len(rows))
            part = self._within(rows, order)
            piece = _pieces(part, len(rows))
            if piece[order[i[left[0]]]] != piece[order[j[left[0]]]]:
                if len(rows) < wanted:
                    raise ValueError(f"nothing joins {starts[left[0]]} and {ends[left[0]]}")
                wanted = 4 * len(rows)
                continue
            # Pairs at the rim have too little around them: they get a neighbourhood of their own.
            inner = np.maximum(order[i[left]], order[j[left]]) < max(len(rows) // 2, 2)
            inner[0] = True
            here = left[inner]
            here = here[piece[order[i[here]]] == piece[order[j[here]]]]
            covariances[here] = self._covariances(part, rows, order[i[here]], order[j[here]], means[here])
            left, wanted = left[~np.isin(left, here)], NEARBY
        return PoseGaussians(means, covariances)

    def _within(self, rows: Rows, order: Rows) -> Factors:
        """Measurements with both ends among the rows."""
        index = self.factors.at(rows)
        both = (order[self.factors.a[index]] < len(rows)) & (order[self.factors.b[index]] < len(rows))
        return self.factors.take(index[both], order)

    def _covariances(self, part: Factors, rows: Rows, i: Rows, j: Rows, means: Array) -> Array:
        """(K, 3, 3) of pairs of rows of a part."""
        information = part.system(self.means[rows], self.huber)[0]
        # Only differences count: one node of each piece is held.
        held = np.zeros((len(rows), 3))
        held[np.unique(_pieces(part, len(rows)), return_index=True)[1]] = ANCHOR_SIGMA**-2
        factor = splu(sparse.csc_matrix(information + sparse.diags(held.ravel())))
        out = np.zeros((len(i), 3, 3))
        for k in range(0, len(i), PAIRS_AT_ONCE):
            some = slice(k, k + PAIRS_AT_ONCE)
            seats, which = np.unique(np.concatenate([i[some], j[some]]), return_inverse=True)
            columns = (3 * seats[:, None] + np.arange(3)).ravel()
            right = np.zeros((3 * len(rows), len(columns)))
            right[columns, np.arange(len(columns))] = 1.0
            joint = factor.solve(right)[columns]
            joint = (0.5 * (joint + joint.T)).reshape(len(seats), 3, len(seats), 3)
            one, two = np.split(which, 2)
            ad = -adjoints(inverse_poses(means[some]))
            cross = ad @ joint[one, :, two, :]
            out[some] = ad @ joint[one, :, one, :] @ ad.transpose(0, 2, 1) + joint[two, :, two, :]
            out[some] += cross + cross.transpose(0, 2, 1)
        return out


def _pieces(part: Factors, count: int) -> Rows:
    """(count,) which connected piece each row is in."""
    links = sparse.coo_matrix((np.ones(len(part)), (part.a, part.b)), shape=(count, count))
    out: Rows = connected_components(links, directed=False)[1]
    return out
