"""Measurements of a large pose graph in columns, and Gauss-Newton on as much of it as a change bears on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from hybridmap.pose import Array
from hybridmap.recognising.pose_arrays import adjoints, compose_poses, inverse_poses
from merge.graph.posegraph import Measurement, factorized

Rows = NDArray[np.int64]


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

    def system(self, means: Array, huber: float) -> tuple[sparse.csc_matrix, Array]:
        """(3N, 3N) information of all right perturbations, and (3N,) how the residuals pull at them."""
        off = self.residuals(means)
        weights = self.weights
        size = np.sqrt(np.einsum("ni,nij,nj->n", off, weights, off))
        held_back = self.robust & (size > huber)
        if held_back.any():
            weights = weights.copy()
            weights[held_back] *= (huber / size[held_back])[:, None, None]
        by_b = _inverse_right_jacobians(off)
        by_a = -by_b @ adjoints(compose_poses(inverse_poses(means[self.b]), means[self.a]))
        from_a, from_b = by_a.transpose(0, 2, 1) @ weights, by_b.transpose(0, 2, 1) @ weights
        blocks = np.concatenate([from_a @ by_a, from_a @ by_b, from_b @ by_a, from_b @ by_b])
        rows, columns = np.concatenate([self.a, self.a, self.b, self.b]), np.concatenate([self.a, self.b] * 2)
        k = np.arange(3)
        i = np.broadcast_to(3 * rows[:, None, None] + k[:, None], blocks.shape)
        j = np.broadcast_to(3 * columns[:, None, None] + k, blocks.shape)
        shape = (3 * len(means), 3 * len(means))
        pull = np.zeros((len(means), 3))
        np.add.at(pull, self.a, -np.einsum("nij,nj->ni", from_a, off))
        np.add.at(pull, self.b, -np.einsum("nij,nj->ni", from_b, off))
        entries = (blocks.ravel(), (i.ravel(), j.ravel()))
        return sparse.csc_matrix(sparse.coo_matrix(entries, shape=shape)), pull.ravel()


@dataclass(frozen=True)
class RelaxSettings:
    """How far a change is followed through the graph.

    Attributes:
        least: nodes that are moved at first.
        growth: so many times as many are moved next, if those at the rim would go on moving.
        rim_xy: moves of nodes at the rim that do not matter, m.
        rim_heading: the same, rad.
        rounds: of Gauss-Newton at most.
        step: they end when nothing moves by more than this, m or rad.
    """

    least: int = 400
    growth: int = 4
    rim_xy: float = 3e-4
    rim_heading: float = 1e-4
    rounds: int = 25
    step: float = 1e-8


def relax(
    factors: Factors, means: Array, held: Rows, touched: Rows, huber: float, s: RelaxSettings
) -> tuple[Array, Rows]:
    """Optimise what a change bears on, from where it was.

    Nodes further and further away are moved along, until those at the rim stay where they are. What is not
    moved holds the rest.

    Args:
        factors: all measurements.
        means: (N, 3) where the nodes are.
        held: rows that never move, one in each component.
        touched: rows where something has changed.
        huber: normalised residual from which a robust measurement pulls no harder.
        s: how far.

    Returns:
        Where the nodes are then, and the rows that were moved.
    """
    fixed = np.zeros(len(means), np.bool_)
    fixed[held] = True
    if not len(touched):
        return means, touched
    before, rows = means, factors.around(touched, s.least, len(means))
    # How far the change reaches is seen before it is worked out to the last digit.
    rough = replace(s, step=max(s.step, 0.5 * min(s.rim_xy, s.rim_heading)))
    while True:
        means = _moved(factors, means, rows[~fixed[rows]], huber, rough)
        inside = np.zeros(len(means), np.bool_)
        inside[rows] = True
        index = factors.at(rows)
        a, b = factors.a[index], factors.b[index]
        rim = np.unique(np.concatenate([a[~inside[b]], b[~inside[a]]]))
        off = np.abs(compose_poses(inverse_poses(before[rim]), means[rim]))
        moves = (off[:, :2] >= s.rim_xy).any(axis=1) | (off[:, 2] >= s.rim_heading)
        if not moves.any():
            return _moved(factors, means, rows[~fixed[rows]], huber, s), rows
        # Where the rim stays, nothing more has to be moved.
        more = math.ceil((s.growth - 1) * len(rows) * moves.mean())
        rows = np.union1d(rows, factors.around(rim[moves], more, len(means)))


def _moved(factors: Factors, means: Array, free: Rows, huber: float, s: RelaxSettings) -> Array:
    """Gauss-Newton on some nodes, the others held."""
    if not len(free):
        return means
    index = factors.at(free)
    others = np.setdiff1d(np.concatenate([factors.a[index], factors.b[index]]), free)
    rows = np.concatenate([free, others])
    row_of = np.zeros(len(means), np.int64)
    row_of[rows] = np.arange(len(rows))
    part, here, n = factors.take(index, row_of), means[rows], 3 * len(free)
    cost, damping = part.cost(here, huber), 0.0
    for _ in range(s.rounds):
        information, pull = part.system(here, huber)
        inner = information[:n, :n]
        damped = inner + sparse.diags(damping * inner.diagonal()) if damping else inner
        step = factorized(damped).solve(pull[:n]).reshape(-1, 3)
        moved = here.copy()
        moved[: len(free)] = compose_poses(here[: len(free)], step)
        after = part.cost(moved, huber)
        if after > cost * (1.0 + 1e-12) + 1e-12:
            damping = max(10.0 * damping, 1e-4)
            continue
        here, cost, damping = moved, after, 0.1 * damping
        if np.abs(step).max() < s.step:
            break
    out = means.copy()
    out[free] = here[: len(free)]
    return out


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
