"""Measurements of a large pose graph in columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from hybridmap.pose import Array
from hybridmap.recognising.pose_arrays import adjoints, compose_poses, inverse_poses
from merge.graph.posegraph import Measurement

Rows = NDArray[np.int64]
CURVED = 0.99
"""Share of the curvature of Huber's loss that Newton's steps heed: with all of it, nothing would hold what a
single limited measurement ties."""


@dataclass(frozen=True, eq=False)
class Factors:
    """M relative postures between the rows of N nodes.

    Attributes:
        a: (M,) row of the one node.
        b: (M,) row of the other.
        means: (M, 3) m, m, rad, `a_from_b`.
        weights: (M, 3, 3) information.
        robust: (M,) whether a measurement may be wrong: then its pull is limited (Huber).
    """

    a: Rows
    b: Rows
    means: Array
    weights: Array
    robust: NDArray[np.bool_]

    @staticmethod
    def of(measurements: Sequence[Measurement], a: Sequence[int], b: Sequence[int]) -> Factors:
        """Of measurements between rows."""
        covariances = np.array([m.covariance for m in measurements]).reshape(-1, 3, 3)
        return Factors(
            np.array(a, np.int64),
            np.array(b, np.int64),
            np.array([m.a_from_b.mean.vector for m in measurements]).reshape(-1, 3),
            np.linalg.inv(covariances),
            np.array([m.robust for m in measurements], np.bool_),
        )

    @staticmethod
    def together(parts: Sequence[Factors], starts: Sequence[tuple[int, int]]) -> Factors:
        """Of all parts, with what is added to their rows a and b."""
        none = Factors.of([], [], [])
        parts, starts = [none, *parts], [(0, 0), *starts]
        counts = [len(part) for part in parts]
        return Factors(
            np.concatenate([p.a for p in parts]) + np.repeat([s[0] for s in starts], counts),
            np.concatenate([p.b for p in parts]) + np.repeat([s[1] for s in starts], counts),
            np.concatenate([p.means for p in parts]),
            np.concatenate([p.weights for p in parts]),
            np.concatenate([p.robust for p in parts]),
        )

    def __len__(self) -> int:
        """How many measurements."""
        return len(self.a)

    def take(self, index: NDArray[np.bool_] | Rows, row_of: Rows) -> Factors:
        """Some of the measurements, between rows that have moved to `row_of`."""
        return Factors(
            row_of[self.a[index]], row_of[self.b[index]], self.means[index], self.weights[index],
            self.robust[index],
        )  # fmt: skip

    @cached_property
    def _by_row(self) -> tuple[Rows, Rows]:
        """Measurements in the order of their rows, each at both of its ends; and where each row begins."""
        ends = np.concatenate([self.a, self.b])
        order = np.argsort(ends, kind="stable")
        count = int(ends.max(initial=-1)) + 1
        return order % max(len(self), 1), np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=count))])

    def at(self, rows: Rows) -> Rows:
        """Measurements that have an end at one of the rows, ascending."""
        order, starts = self._by_row
        rows = rows[rows < len(starts) - 1]
        lengths = starts[rows + 1] - starts[rows]
        index = np.repeat(starts[rows] - np.cumsum(lengths) + lengths, lengths) + np.arange(lengths.sum())
        return np.unique(order[index])

    def around(self, rows: Rows, least: int, nodes: int) -> Rows:
        """Rows and their neighbours, ring by ring, until there are enough or no more.

        Args:
            rows: to begin with.
            least: how many are enough.
            nodes: how many rows there are.
        """
        found = np.zeros(nodes, np.bool_)
        ring = np.unique(rows)
        out = [ring]
        found[ring] = True
        while len(ring) and sum(map(len, out)) < least:
            index = self.at(ring)
            ends = np.unique(np.concatenate([self.a[index], self.b[index]]))
            ring = ends[~found[ends]]
            found[ring] = True
            out.append(ring)
        return np.concatenate(out)

    def residuals(self, means: Array) -> Array:
        """(M, 3) of all measurements, along the exponential map, in their b as it is measured."""
        between = compose_poses(inverse_poses(means[self.a]), means[self.b])
        return _logarithms(compose_poses(inverse_poses(self.means), between))

    def strains(self, means: Array) -> Array:
        """(M,) chi-square with 3 degrees of freedom."""
        off = self.residuals(means)
        out: Array = np.einsum("ni,nij,nj->n", off, self.weights, off)
        return out

    def cost(self, means: Array, huber: float) -> float:
        """Half the chi-square, of robust measurements no more than Huber's loss."""
        squared = self.strains(means)
        size = np.sqrt(squared)
        limited = self.robust & (size > huber)
        return float(np.where(limited, huber * (size - 0.5 * huber), 0.5 * squared).sum())

    @cached_property
    def _layout(self) -> tuple[Rows, Rows, Rows, Rows]:
        """Of the blocks (a, a), (a, b), (b, a), (b, b): their order by rows and columns, and where in it each
        seat of the information begins; rows and columns of the seats.
        """
        rows, columns = np.concatenate([self.a, self.a, self.b, self.b]), np.concatenate([self.a, self.b] * 2)
        order = np.lexsort([columns, rows])
        rows, columns = rows[order], columns[order]
        new = np.ones(len(rows), np.bool_)
        new[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
        starts = np.flatnonzero(new)
        return order, starts, rows[starts], columns[starts]

    def system(self, means: Array, huber: float, curved: bool = False) -> tuple[sparse.csc_matrix, Array]:
        """(3N, 3N) information of all right perturbations, and (3N,) how the residuals pull at them.

        Args:
            means: (N, 3) where the nodes are.
            huber: normalised residual from which a robust measurement pulls no harder.
            curved: with the curvature of the loss: what pulls no harder resists no more where it pulls
                either. That is Newton's step, which is good near the solution only.
        """
        off = self.residuals(means)
        weights = self.weights
        pulled = np.einsum("nij,nj->ni", weights, off)
        squared = np.einsum("ni,ni->n", off, pulled)
        limited = np.flatnonzero(self.robust & (squared > huber**2))
        if len(limited):
            held_back = huber / np.sqrt(squared[limited])
            weights = weights.copy()
            if curved:
                along = np.einsum("ni,nj->nij", pulled[limited], pulled[limited])
                weights[limited] -= CURVED * along / squared[limited, None, None]
            weights[limited] *= held_back[:, None, None]
            pulled[limited] *= held_back[:, None]
        by_b = _inverse_right_jacobians(off)
        by_a = -by_b @ adjoints(compose_poses(inverse_poses(means[self.b]), means[self.a]))
        from_a, from_b = by_a.transpose(0, 2, 1) @ weights, by_b.transpose(0, 2, 1) @ weights
        pull = np.zeros((len(means), 3))
        np.add.at(pull, self.a, -np.einsum("nji,nj->ni", by_a, pulled))
        np.add.at(pull, self.b, -np.einsum("nji,nj->ni", by_b, pulled))
        order, starts, rows, columns = self._layout
        blocks = np.concatenate([from_a @ by_a, from_a @ by_b, from_b @ by_a, from_b @ by_b])[order]
        seats = np.add.reduceat(blocks, starts) if len(starts) else blocks
        begins = np.searchsorted(rows, np.arange(len(means) + 1))
        shape = (3 * len(means), 3 * len(means))
        by_rows = sparse.bsr_matrix((seats, columns, begins), shape=shape).tocsr()
        # Columns of a symmetric matrix are its rows.
        entries = by_rows.data, by_rows.indices, by_rows.indptr
        return sparse.csc_matrix(entries, shape=shape), pull.ravel()


def _logarithms(poses: Array) -> Array:
    """(N, 3) of (N, 3) postures: the twist that leads there in unit time."""
    half = 0.5 * poses[:, 2]
    small = np.abs(half) < 1e-6
    h = np.where(small, 1.0, half / np.tan(np.where(small, 1.0, half)))
    x, y = poses[:, 0], poses[:, 1]
    return np.stack([h * x + half * y, h * y - half * x, poses[:, 2]], axis=1)


def _inverse_right_jacobians(twists: Array) -> Array:
    """(N, 3, 3) how a logarithm changes with a perturbation on the right.

    I + ad / 2 + c ad^2, with c such that it is exact, because ad^3 = -heading^2 ad in the plane.
    """
    ad = np.zeros((len(twists), 3, 3))
    ad[:, 0, 1], ad[:, 0, 2] = -twists[:, 2], twists[:, 1]
    ad[:, 1, 0], ad[:, 1, 2] = twists[:, 2], -twists[:, 0]
    half = 0.5 * twists[:, 2]
    small = np.abs(half) < 1e-3
    safe = np.where(small, 1.0, half)
    c = np.where(small, 1.0 / 12.0 + half**2 / 180.0, (1.0 - safe / np.tan(safe)) / (4.0 * safe**2))
    out: Array = np.eye(3) + 0.5 * ad + c[:, None, None] * (ad @ ad)
    return out
