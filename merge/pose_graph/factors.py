"""Measurements of a pose graph in columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.registration.pose_arrays import adjoints, compose_poses, inverse_poses

if TYPE_CHECKING:
    from scipy import sparse

Rows = NDArray[np.int64]
LEAST_SIGMAS = np.array([1e-3, 1e-3, 2e-4])
"""No measurement is better than this, m, m, rad: it keeps the graph well conditioned."""
LOOP_FLOOR = np.diag([0.02**2, 0.02**2, 0.01**2])
"""Covariance of any loop beyond what its measurements tell of, m, m, rad: 2 cm and 0.6 degrees. Chosen, for
floors and cameras that differ from what the maps suppose. Synthetic maps know of none: in eight fleets (half
and 80 % of the links false) the same links are kept, all true ones and no other, with none, half, twice and
four times as much. What it does on real images is not measured."""
LEAST_SHARE = 2e-6
"""Least share of the covariance's trace in any direction: the wire's rounding is half as large
(`mapweave.hybridmap.pose`), and the solver cannot resolve less."""


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A measured relative pose of two nodes.

    Attributes:
        a: one node.
        b: another one.
        a_from_b: pose of b in a.
        robust: whether it may be wrong: a link, or a robot's own claim.
    """

    a: NodeId
    b: NodeId
    a_from_b: PoseGaussian
    robust: bool = False

    @property
    def covariance(self) -> Array:
        """(3, 3), not smaller than the floor."""
        return believable(self.a_from_b.covariance)


def believable(covariances: Array) -> Array:
    """(..., 3, 3) covariances of measurements, each raised to the floor."""
    share = LEAST_SHARE * np.trace(covariances, axis1=-2, axis2=-1)
    least = np.maximum(LEAST_SIGMAS**2, share[..., None])
    out: Array = covariances + least[..., None] * np.eye(3)
    return out


@dataclass(frozen=True, eq=False)
class Factors:
    """M relative poses between the rows of N nodes.

    Attributes:
        a: (M,) row of the first node.
        b: (M,) row of the other.
        means: (M, 3) m, m, rad, `a_from_b`.
        weights: (M, 3, 3) information.
    """

    a: Rows
    b: Rows
    means: Array
    weights: Array

    @staticmethod
    def of(measurements: Sequence[RelativePose], a: Sequence[int], b: Sequence[int]) -> Factors:
        """The factors of measurements between rows."""
        covariances = np.array([m.a_from_b.covariance for m in measurements]).reshape(-1, 3, 3)
        means = [(m.x, m.y, m.heading) for m in (measurement.a_from_b.mean for measurement in measurements)]
        return Factors(
            np.array(a, np.int64),
            np.array(b, np.int64),
            np.array(means).reshape(-1, 3),
            np.asarray(np.linalg.inv(believable(covariances)), np.float64),
        )

    @staticmethod
    def together(parts: Sequence[Factors]) -> Factors:
        """The factors of all parts, which have the same rows."""
        columns = ("a", "b", "means", "weights")
        return Factors(*(np.concatenate([getattr(part, name) for part in parts]) for name in columns))

    def __len__(self) -> int:
        return len(self.a)

    def take(self, index: NDArray[np.bool_] | Rows, row_of: Rows | None = None) -> Factors:
        """Some of the measurements, by mask or index; row r of the poses has moved to `row_of[r]`."""
        a, b = self.a[index], self.b[index]
        if row_of is not None:
            a, b = row_of[a], row_of[b]
        return Factors(a, b, self.means[index], self.weights[index])

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
        reached = np.zeros(nodes, np.bool_)
        ring = np.unique(rows)
        out = [ring]
        reached[ring] = True
        while len(ring) and sum(map(len, out)) < least:
            index = self.at(ring)
            ends = np.unique(np.concatenate([self.a[index], self.b[index]]))
            ring = ends[~reached[ends]]
            reached[ring] = True
            out.append(ring)
        return np.concatenate(out)

    def information(self, means: Array, held: Rows, precision: float) -> sparse.csc_matrix:
        """(3N, 3N) of the right perturbations of all nodes.

        A residual's derivative is (-Ad(b_from_a), identity), to first order in the residual.

        Args:
            means: (N, 3) where the nodes are.
            held: rows of nodes that are held there.
            precision: how well, 1/m^2 and 1/rad^2.
        """
        from scipy import sparse

        by_a = -adjoints(compose_poses(inverse_poses(means[self.b]), means[self.a]))
        transposed = by_a.transpose(0, 2, 1)
        weights = self.weights
        blocks = np.concatenate([transposed @ weights @ by_a, transposed @ weights, weights @ by_a, weights])
        rows = np.concatenate([self.a, self.a, self.b, self.b])
        columns = np.concatenate([self.a, self.b, self.a, self.b])
        k = np.arange(3)
        i = np.broadcast_to(3 * rows[:, None, None] + k[:, None], blocks.shape).ravel()
        j = np.broadcast_to(3 * columns[:, None, None] + k, blocks.shape).ravel()
        diagonal = (3 * held[:, None] + k).ravel()
        entries = np.concatenate([blocks.ravel(), np.full(len(diagonal), precision)])
        # One sum of all entries: in small graphs a sum of two sparse matrices takes as long as all else here.
        places = np.concatenate([i, diagonal]), np.concatenate([j, diagonal])
        return sparse.csc_matrix((entries, places), shape=(3 * len(means), 3 * len(means)))
