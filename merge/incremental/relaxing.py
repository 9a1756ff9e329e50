"""Newton's method on as much of a large pose graph as a change bears on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from hybridmap.pose import Array
from hybridmap.recognising.pose_arrays import compose_poses, inverse_poses
from merge.graph.posegraph import factorized
from merge.incremental.factors import Factors, Rows

NEAR = 0.03
"""Newton's steps begin once nothing moves by more than this, m or rad."""
ROUGH = 4
"""Rounds after which it is seen how far a change reaches."""
LEAST_GROWTH = 0.25
"""As many nodes as this share of those that were moved are added at least, if any at the rim move."""


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
    rough = replace(s, step=max(s.step, 0.5 * min(s.rim_xy, s.rim_heading)), rounds=min(s.rounds, ROUGH))
    how = rough
    while True:
        means = _moved(factors, means, rows[~fixed[rows]], huber, how)
        rim, share = _moving_rim(factors, before, means, rows, s)
        if len(rim):
            # Where the rim stays, nothing more has to be moved.
            more = math.ceil(max((s.growth - 1) * share, LEAST_GROWTH) * len(rows))
            rows, how = np.union1d(rows, factors.around(rim, more, len(means))), rough
        elif how is s:
            return means, rows
        else:
            how = s


def _moving_rim(
    factors: Factors, before: Array, means: Array, rows: Rows, s: RelaxSettings
) -> tuple[Rows, float]:
    """Rows that have moved beside rows that were held; and how many these are of all at the rim."""
    inside = np.zeros(len(means), np.bool_)
    inside[rows] = True
    index = factors.at(rows)
    a, b = factors.a[index], factors.b[index]
    rim = np.unique(np.concatenate([a[~inside[b]], b[~inside[a]]]))
    off = np.abs(compose_poses(inverse_poses(before[rim]), means[rim]))
    moves = (off[:, :2] >= s.rim_xy).any(axis=1) | (off[:, 2] >= s.rim_heading)
    return rim[moves], float(moves.mean()) if len(rim) else 0.0


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
    cost, damping, near = part.cost(here, huber), 0.0, NEAR
    curved = False
    for _ in range(s.rounds):
        information, pull = part.system(here, huber, curved)
        inner = information[:n, :n]
        damped = inner + sparse.diags(damping * inner.diagonal()) if damping else inner
        step = factorized(damped).solve(pull[:n]).reshape(-1, 3)
        moved = here.copy()
        moved[: len(free)] = compose_poses(here[: len(free)], step)
        after = part.cost(moved, huber)
        if after > cost * (1.0 + 1e-12) + 1e-12:
            if curved:
                curved, near = False, 0.25 * near
            else:
                damping = max(10.0 * damping, 1e-4)
            continue
        here, cost, damping = moved, after, 0.1 * damping
        far = float(np.abs(step).max())
        if far < s.step:
            break
        curved = far < near
    out = means.copy()
    out[free] = here[: len(free)]
    return out
