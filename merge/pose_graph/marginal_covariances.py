"""Marginal covariances of all nodes of a pose graph at once: the diagonal blocks of the inverse information.

With information = L D L^T by blocks of a node each, the blocks of the inverse at which L has entries follow
from each other, last node first (Takahashi's equations; Erisman and Tinney, 1975), since in

    Z_Sj = -Z_SS L_Sj,    Z_jj = D_j^-1 - L_Sj^T Z_Sj,    S: rows of L below the diagonal in column j

Z_SS is within what was worked out for the first row of S. Solving for the columns of each node instead takes
as many solutions of the whole system as there are nodes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array

if TYPE_CHECKING:
    from scipy import sparse

AXES = np.arange(3)
Rows = NDArray[np.int64]


def marginal_covariances(information: sparse.csc_matrix) -> Array:
    """(N, 3, 3) covariance of each node.

    Args:
        information: (3N, 3N), positive definite.

    Raises:
        LinAlgError: a node is determined by nothing.
    """
    from scipy import sparse

    order, columns = _fill(information)
    count = len(order)
    rows = _rows(order)
    blocks = sparse.csc_matrix(information)[rows][:, rows].tobsr((3, 3))
    blocks.sort_indices()
    children: list[list[int]] = [[] for _ in range(count)]
    for j, own in enumerate(columns):
        if len(own) > 1:
            children[own[1]].append(j)
    inverses, lower = np.empty((count, 3, 3)), []
    # What the nodes before leave of the information of those after them, (3K, 3K) for the K rows of S.
    left: dict[int, Array] = {}
    for j, own in enumerate(columns):
        assembled = np.zeros((len(own), 3, len(own), 3))
        seats = blocks.indices[blocks.indptr[j] : blocks.indptr[j + 1]]
        values = blocks.data[blocks.indptr[j] : blocks.indptr[j + 1]][seats >= j]
        at = np.searchsorted(own, seats[seats >= j])
        assembled[0, :, at, :] = values
        assembled[at, :, 0, :] = values.transpose(0, 2, 1)
        front = assembled.reshape(3 * len(own), 3 * len(own))
        for child in children[j]:
            within = _rows(np.searchsorted(own, columns[child][1:]))
            front[within[:, None], within] += left.pop(child)
        inverses[j] = np.linalg.inv(front[:3, :3])
        inverses[j] = _symmetric(inverses[j])
        lower.append(front[3:, :3] @ inverses[j])
        left[j] = front[3:, 3:] - lower[j] @ front[:3, 3:]
    out = np.empty((count, 3, 3))
    # Each with the rows of its parent's front and the covariance of these: in depth first few are kept.
    ahead: list[tuple[int, Rows, Array]] = [
        (j, own, np.zeros((0, 0))) for j, own in enumerate(columns) if len(own) == 1
    ]
    while ahead:
        j, outer, known = ahead.pop()
        own = columns[j]
        within = _rows(np.searchsorted(outer, own[1:]))
        joint = np.empty((3 * len(own), 3 * len(own)))
        joint[3:, 3:] = rest = known[within[:, None], within]
        joint[3:, :3] = cross = -(rest @ lower[j])
        joint[:3, 3:] = cross.T
        joint[:3, :3] = out[order[j]] = _symmetric(inverses[j] - lower[j].T @ cross)
        ahead += [(child, own, joint) for child in children[j]]
    return out


def _fill(information: sparse.csc_matrix) -> tuple[Rows, list[Rows]]:
    """An order of the nodes that keeps L sparse, and the rows of each of its columns: its own, those below.

    Returns:
        (N,) nodes in their order; and rows in this order.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    entries = information.tocoo()
    count = information.shape[0] // 3
    joined = sparse.coo_matrix(
        (np.ones(entries.nnz), (entries.row // 3, entries.col // 3)), shape=(count, count)
    ).tocsr()
    joined.data[:] = -1.0
    joined.setdiag(0.0)
    # Of a matrix whose other entries are all negative no entry of L is zero by chance.
    surplus = sparse.diags(1.0 - np.asarray(joined.sum(axis=1)).ravel())
    factor = splu(
        sparse.csc_matrix(joined + surplus),
        permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True},
    )  # fmt: skip
    lower = factor.L.tocsc()
    lower.sort_indices()
    return np.argsort(factor.perm_c), np.split(lower.indices.astype(np.int64), lower.indptr[1:-1])


def _rows(nodes: Rows) -> Rows:
    """(3K,) the three rows of each of K nodes."""
    rows: Rows = (3 * nodes[:, None] + AXES).ravel()
    return rows


def _symmetric(matrix: Array) -> Array:
    half: Array = 0.5 * (matrix + matrix.T)
    return half
