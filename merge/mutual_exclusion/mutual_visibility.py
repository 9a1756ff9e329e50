"""Mutual visibility: robots whose proximity sensors should have seen each other, and did not.

Nodes have the readings of their robot's proximity sensors; the other robot's pose at that time is on its
trajectory. A ray at an angle δ beside the other's middle, d away, meets its footprint of radius r at
d cos δ - √(r² - d² sin² δ). If the ray went on, the other robot was not there. If it ended there, it may have
been. If it ended before, something was in between, and if it passed beside, nothing is known.

**Why a true merge is safe.** Let a robot be there with nothing in between. A sensor misses it with a
probability of at most ε (`MISSED`), else it sees it. The alternative is a world with other things, one of
which ends the ray just there with probability q (`SCENERY`). The measurement is then (1 - q) / ε times as
likely if the ray went on, and q / (1 - ε) times as likely if it ended there. Under a true merge these odds
against it have an expectation of ε' (1 - q) / ε + (1 - ε') q / (1 - ε), where ε' ≤ ε is the sensors' true
miss rate. That is at most 1: it grows with ε', and is 1 at ε. It holds for any q; q only decides how soon a
false merge is refuted. Whether something is in between is left open by both: the odds are 1.

The other robot's pose is known by samples only. A measurement makes some of them likelier than others: a
sample is weighted by the likelihood of the measurement, 1 where nothing is known, ε where the ray went on,
(1 - ε) / q where it ended. The mean of the odds with these weights is the likelihood ratio of the two worlds,
whichever sample is true, and its expectation is again at most 1. Samples in which the footprints overlap are
left to `mapweave.merge.mutual_exclusion.exclusion`: so these odds are fair given the robots' poses, and may
be multiplied with those.

Errors of the robots' poses are common to all moments, which samples of single moments ignore. So all poses
are moved together, along their principal components, by up to three standard deviations. Each such mode has
its probability: under a merge the likelihood of the measurements is the mean over all modes, and the odds
against the merge are one over the mean of their inverses.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.merge.mutual_exclusion.quadrature import quadrature_points
from mapweave.merge.mutual_exclusion.visibility_intervals import VisibilityInterval
from mapweave.merge.pose_graph.solved_graph import PoseGraph


@dataclass(frozen=True, eq=False)
class Errors:
    """Common pose errors of two robots: S modes for M observations.

    Attributes:
        shifts: (S, M, 2) m, how the other one would then be elsewhere, as the observers see it.
        rest: (M, 2, 2) m^2, covariance of each observation's own error.
        weights: (S,) how probable each way is.
    """

    shifts: Array
    rest: Array
    weights: Array


MODES = 3
"""Modes of the relative pose of two maps: along, across, and rotation."""


def none_wrong(intervals: VisibilityInterval) -> Errors:
    """No pose errors."""
    return Errors(np.zeros((1, len(intervals), 2)), np.zeros((len(intervals), 2, 2)), np.ones(1))


FLOOR_XY = 0.03
"""Error of how the two maps lie to each other that no covariance tells of, m."""
SIGMAS = (0.0, 1.0, 2.0, 3.0)
"""The poses are moved by so many standard deviations, in every direction."""


def errors_in_common(graph: PoseGraph, intervals: VisibilityInterval, floor_xy: float = FLOOR_XY) -> Errors:
    """The principal components of the errors common to all observations.

    Args:
        graph: of the nodes.
        intervals: at least one observation.
        floor_xy: error of how the two maps lie to each other that no covariance tells of, m.

    Returns:
        Shifts of SIGMAS standard deviations along each component and between them.
    """
    import scipy.linalg

    rows = np.unique(np.concatenate([intervals.observers, intervals.others]))
    joint = graph.covariance([graph.nodes[k] for k in rows]).reshape(3 * len(rows), -1)
    headings = graph.means[:, 2]
    interval_rows = np.arange(len(intervals))
    # Right perturbations: a node moves along its own axes, and its observations turn with it. The same holds
    # for the other robot's node.
    by_node = np.zeros((len(intervals), 2, len(rows), 3))
    seats = np.searchsorted(rows, intervals.observers)
    by_node[interval_rows, :, seats, :2] = -_rotations(headings[intervals.observers])
    by_node[interval_rows, :, seats, 2] = -_turned(intervals.levers + intervals.offsets)
    seats = np.searchsorted(rows, intervals.others)
    by_node[interval_rows, :, seats, :2] = _rotations(headings[intervals.others])
    by_node[interval_rows, :, seats, 2] = _turned(intervals.other_levers)
    design = by_node.reshape(2 * len(intervals), -1)
    # The error between the maps has opposite signs for the two observers.
    agents = np.array([graph.nodes[row].agent for row in intervals.others])
    apart = np.kron(np.where(agents == agents[0], 1.0, -1.0)[:, None], np.eye(2))
    root = np.linalg.cholesky(joint + 1e-10 * np.eye(len(joint)))
    factor = np.hstack([design @ root, floor_xy * apart])
    # There are many more observations than nodes, so the principal components come from the smaller side.
    count = min(MODES, *factor.shape)
    _, vectors = scipy.linalg.eigh(
        factor.T @ factor, subset_by_index=[factor.shape[1] - count, factor.shape[1] - 1]
    )
    modes = factor @ vectors
    ways, weights = _shells(count, np.array(SIGMAS))
    by_interval = modes.reshape(len(intervals), 2, count)
    own = np.einsum("mik,mjk->mij", *[factor.reshape(len(intervals), 2, -1)] * 2)
    rest = own - by_interval @ by_interval.transpose(0, 2, 1)
    return Errors((ways @ modes.T).reshape(len(ways), len(intervals), 2), rest, weights)


def _shells(count: int, radii: Array) -> tuple[Array, Array]:
    """(S, count) points of a normal distribution, on shells of ascending radii, and (S,) their weights."""
    import scipy.special

    ways = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=count) if any(way)])
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    edges = np.concatenate([[0.0], (radii[:-1] + radii[1:]) / 2.0, [np.inf]])
    # The distance from the origin is chi distributed; scipy.stats has it too, but takes a second to import.
    shells = np.diff(scipy.special.gammainc(0.5 * count, 0.5 * edges**2))
    points = [radius * ways if radius > 0.0 else np.zeros((1, count)) for radius in radii]
    weights = [np.full(len(some), shell / len(some)) for some, shell in zip(points, shells, strict=True)]
    return np.concatenate(points), np.concatenate(weights)


def _rotations(headings: Array) -> Array:
    """(M, 2, 2) rotation matrices."""
    cos, sin = np.cos(headings), np.sin(headings)
    out: Array = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
    return out


def _turned(ways: Array) -> Array:
    """(M, 2) how the ends of ways move, m for each rad by which their beginnings turn."""
    out: Array = ways[:, ::-1] * [-1.0, 1.0]
    return out


def odds_against(
    intervals: VisibilityInterval,
    errors: Errors,
    least_apart: float,
) -> Array:
    """(S, M) odds against the merge of each observation, for each mode of the pose errors.

    Args:
        intervals: the observations.
        errors: the ways.
        least_apart: the robots' middles are never nearer than this, m.
    """
    samples = quadrature_points(intervals.spreads + errors.rest)
    out: Array = np.array(
        [
            _odds(intervals, intervals.offsets[:, None] + shift[:, None] + samples, least_apart)
            for shift in errors.shifts
        ]
    )
    return out


MISSED = 0.1
"""Share of looks, at most, in which the sensors miss a robot that stands in their way."""
SCENERY = 0.2
"""How often something else ends a ray where the robot would have been."""


def _odds(intervals: VisibilityInterval, places: Array, least_apart: float) -> Array:
    """(M,) odds against the merge if the other one was equally likely at each of (M, D, 2) places, m."""
    passed, ended = _outcomes(intervals, places)
    possible = np.hypot(places[..., 0], places[..., 1]) >= least_apart
    on = (passed & possible).sum(axis=1)
    ended_inside = (ended & ~passed & possible).sum(axis=1)
    # A small constant: if no sample is possible, nothing is known.
    unknown = possible.sum(axis=1) - on - ended_inside + 1e-9
    without = unknown + (1.0 - SCENERY) * on + ended_inside
    out: Array = without / (unknown + MISSED * on + (1.0 - MISSED) / SCENERY * ended_inside)
    return out


CORE = 0.8
"""A ray surely meets a robot if it comes as near to its middle as this share of its radius: few robots are
round, but a square hides this much to four of five sides."""
MARGIN = 0.1
"""A ray went on if it is longer by more than this than where it would have met the robot, m."""
MARGIN_SHARE = 0.05
"""The same as a share of that distance."""


def _outcomes(intervals: VisibilityInterval, places: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(M, D) whether a ray went on where it would have met the other one, and whether one ended there."""
    middles = places.mean(axis=1)
    wander = np.hypot(*(places - middles[:, None]).transpose(2, 0, 1)).max(axis=1)
    u, middle = intervals.directions, middles[intervals.looks]
    across = np.abs(u[:, 0] * middle[:, 1] - u[:, 1] * middle[:, 0])
    along = (u * middle).sum(axis=1)
    reach = (CORE * intervals.radii + wander)[intervals.looks]
    may_meet = np.flatnonzero((across < reach) & (along > -reach) & (intervals.lengths > along - 2.0 * reach))
    rows, u, lengths = intervals.looks[may_meet], u[may_meet], intervals.lengths[may_meet, None]
    x, y = places[rows, :, 0], places[rows, :, 1]
    along = u[:, :1] * x + u[:, 1:] * y
    across2 = (u[:, :1] * y - u[:, 1:] * x) ** 2
    radii = intervals.radii[rows, None]
    core = (CORE * radii) ** 2 - across2
    meets = (core > 0.0) & (along > 0.0)
    first = along - np.sqrt(np.maximum(radii**2 - across2, 0.0))
    last = along - np.sqrt(np.maximum(core, 0.0))
    margins = MARGIN + MARGIN_SHARE * last
    free = meets & (lengths >= first - margins)
    beyond = free & (lengths > last + margins)
    shape = places.shape[:2]
    passed, ended = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    if len(rows):
        starts = np.flatnonzero(np.diff(rows, prepend=-1))
        passed[rows[starts]] = np.logical_or.reduceat(beyond, starts, axis=0)
        ended[rows[starts]] = np.logical_or.reduceat(free & ~beyond, starts, axis=0)
    return passed, ended
