"""A solved component of many nodes: covariances are worked out around where they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from hybridmap.node import NodeId
from hybridmap.pose import Array
from hybridmap.recognising.pose_arrays import PoseGaussians, adjoints, compose_poses, inverse_poses
from merge.graph.posegraph import ANCHOR_SIGMA, PoseGraph, factorized
from merge.incremental.factors import Factors, Rows

NEARBY = 300
"""Nodes around pairs whose measurements say how these stand to each other; more, if none joins them ..."""
AROUND = 4
"""... and so many at least for each node of the pairs."""
ROWS_AT_ONCE = 96
"""Nodes for which it is worked out together."""


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
        left, least = np.flatnonzero(i != j), NEARBY
        while len(left):
            apart = []
            # Rows of one map are together, and what is near each other shares its surroundings.
            for some in _shares(left[np.lexsort([j[left], i[left]])], i, j):
                covariances[some], joined = self._covariances(i[some], j[some], means[some], least)
                apart.append(some[~joined])
            left = np.concatenate(apart)
            if len(left) and least >= len(self.nodes):
                k = int(left[0])
                raise ValueError(f"nothing joins {starts[k]} and {ends[k]}")
            least *= 4
        return PoseGaussians(means, covariances)

    def _covariances(self, i: Rows, j: Rows, means: Array, least: int) -> tuple[Array, NDArray[np.bool_]]:
        """Of pairs of rows, by what was measured around all of them.

        Args:
            i: (K,) rows.
            j: (K,) rows.
            means: (K, 3) of j in i.
            least: nodes at least that are around them.

        Returns:
            (K, 3, 3); and (K,) whether what is around joins a pair: else its covariance means nothing.
        """
        seats, which = np.unique(np.concatenate([i, j]), return_inverse=True)
        rows = self.factors.around(seats, max(least, AROUND * len(seats)), len(self.nodes))
        order = np.full(len(self.nodes), len(rows))
        order[rows] = np.arange(len(rows))
        part = self._within(rows, order)
        piece = _pieces(part, len(rows))
        # Only differences count: one node of each piece is held.
        held = np.zeros((len(rows), 3))
        held[np.unique(piece, return_index=True)[1]] = ANCHOR_SIGMA**-2
        information = part.system(self.means[rows], self.huber)[0] + sparse.diags(held.ravel())
        columns = (3 * order[seats][:, None] + np.arange(3)).ravel()
        right = np.zeros((3 * len(rows), len(columns)))
        right[columns, np.arange(len(columns))] = 1.0
        joint = factorized(information).solve(right)[columns]
        joint = (0.5 * (joint + joint.T)).reshape(len(seats), 3, len(seats), 3)
        one, two = np.split(which, 2)
        ad = -adjoints(inverse_poses(means))
        cross = ad @ joint[one, :, two, :]
        out = ad @ joint[one, :, one, :] @ ad.transpose(0, 2, 1) + joint[two, :, two, :]
        joined = piece[order[i]] == piece[order[j]]
        return out + cross + cross.transpose(0, 2, 1), joined

    def _within(self, rows: Rows, order: Rows) -> Factors:
        """Measurements with both ends among the rows."""
        index = self.factors.at(rows)
        both = (order[self.factors.a[index]] < len(rows)) & (order[self.factors.b[index]] < len(rows))
        return self.factors.take(index[both], order)


def _shares(pairs: Rows, i: Rows, j: Rows) -> list[Rows]:
    """Pairs of rows i and j, in their order, so many at a time that few rows are involved."""
    out: list[list[int]] = []
    involved: set[int] = set()
    for k in pairs.tolist():
        here = {int(i[k]), int(j[k])}
        if not out or len(involved | here) > ROWS_AT_ONCE:
            out.append([])
            involved = set()
        involved |= here
        out[-1].append(k)
    return [np.array(some, np.int64) for some in out]


def _pieces(part: Factors, count: int) -> Rows:
    """(count,) which connected piece each row is in."""
    links = sparse.coo_matrix((np.ones(len(part)), (part.a, part.b)), shape=(count, count))
    out: Rows = connected_components(links, directed=False)[1]
    return out
