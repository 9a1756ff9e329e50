"""Sight: robots whose proximity sensors should have seen each other, and saw nothing there.

Nodes say how far their robot's proximity sensors saw; where the other robot was at that time its trail tells.
A ray at an angle δ beside the other's middle, d away, meets its body of radius r at
d cos δ - √(r² - d² sin² δ). If the ray went on, the other robot was not there. If it ended there, it may well
have been. If it ended before, something was in between, and if it passed beside, nothing is known.

**Why a true merge is safe.** Say a robot stands there and nothing is in between. A sensor misses it with a
chance of ε at most (`missed`), else it sees it. Against this stands a world with other things in it, one of
which ends the ray just there with a chance of q (`scenery`). What was measured is then (1 - q) / ε times as
likely if the ray went on, and q / (1 - ε) times as likely if it ended there. Under a true merge these odds
against it have an expectation of ε' (1 - q) / ε + (1 - ε') q / (1 - ε), where ε' ≤ ε is how often the
sensors really miss. That is at most 1: it grows with ε', and is 1 at ε. It holds whatever q is; q only says
how soon a false merge falls. Whether something is in between is left open by both: the odds are 1.

Where the other robot was is known by draws only. A measurement makes some of them likelier than others: a
draw is weighed with how likely it makes what was measured, 1 where nothing is known, ε where the ray went
on, (1 - ε) / q where it ended. The mean of the odds, weighed like this, is the likelihood of the one world
over that of the other, whichever draw is true, and its expectation is again at most 1. Draws in which the
bodies overlap are left to `mapweave.merge.mutual_exclusion.exclusion`: so these odds are fair given where
the robots are, and may be multiplied with those.

What is wrong with the robots' poses is wrong at all moments alike, of which draws for single moments
know nothing. So all poses are moved together, in the ways in which they are most uncertain, by up to three
standard deviations. Each way is as probable as it is: under a merge what was measured is as likely as it is
on average over all of them, and the odds against the merge are one over the mean of their inverses.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.linalg
import scipy.special
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.merge.mutual_exclusion.quadrature import quadrature_points
from mapweave.merge.mutual_exclusion.visibility_intervals import VisibilityInterval
from mapweave.merge.pose_graph.solved_graph import PoseGraph


@dataclass(frozen=True, eq=False)
class Errors:
    """How two robots' poses may be wrong, together: S ways for M looks.

    Attributes:
        shifts: (S, M, 2) m, how the other one would then be elsewhere, as the observers see it.
        rest: (M, 2, 2) m^2, covariance of what is wrong with each look alone.
        weights: (S,) how probable each way is.
    """

    shifts: Array
    rest: Array
    weights: Array


MODES = 3
"""Ways in which two maps can be wrong as a whole: along, aside, and turned."""


def none_wrong(seen: VisibilityInterval) -> Errors:
    """All poses are what they are thought to be."""
    return Errors(np.zeros((1, len(seen), 2)), np.zeros((len(seen), 2, 2)), np.ones(1))


FLOOR_XY = 0.03
"""Error of how the two maps lie to each other that no covariance tells of, m."""
SIGMAS = (0.0, 1.0, 2.0, 3.0)
"""The poses are moved by so many standard deviations, in every direction."""


def errors_in_common(graph: PoseGraph, seen: VisibilityInterval, floor_xy: float = FLOOR_XY) -> Errors:
    """The principal components of what may be wrong with all looks.

    Args:
        graph: of the nodes.
        seen: at least one look.
        floor_xy: error of how the two maps lie to each other that no covariance tells of, m.

    Returns:
        Shifts of SIGMAS standard deviations along each component and between them.
    """
    rows = np.unique(np.concatenate([seen.observers, seen.others]))
    joint = graph.covariance([graph.nodes[k] for k in rows]).reshape(3 * len(rows), -1)
    headings = graph.means[:, 2]
    looks = np.arange(len(seen))
    # Right perturbations: a node moves along its own axes, and all that it looks at turns with it. So does
    # the robot that was on its way from it.
    by_node = np.zeros((len(seen), 2, len(rows), 3))
    seats = np.searchsorted(rows, seen.observers)
    by_node[looks, :, seats, :2] = -_rotations(headings[seen.observers])
    by_node[looks, :, seats, 2] = -_turned(seen.levers + seen.offsets)
    seats = np.searchsorted(rows, seen.others)
    by_node[looks, :, seats, :2] = _rotations(headings[seen.others])
    by_node[looks, :, seats, 2] = _turned(seen.other_levers)
    design = by_node.reshape(2 * len(seen), -1)
    # What is between the maps the one sees from the one side, the other from the other.
    agents = np.array([graph.nodes[row].agent for row in seen.others])
    apart = np.kron(np.where(agents == agents[0], 1.0, -1.0)[:, None], np.eye(2))
    root = np.linalg.cholesky(joint + 1e-10 * np.eye(len(joint)))
    factor = np.hstack([design @ root, floor_xy * apart])
    # There are many more looks than nodes, so the principal components come from the smaller side.
    count = min(MODES, *factor.shape)
    _, vectors = scipy.linalg.eigh(
        factor.T @ factor, subset_by_index=[factor.shape[1] - count, factor.shape[1] - 1]
    )
    modes = factor @ vectors
    ways, weights = _shells(count, np.array(SIGMAS))
    by_look = modes.reshape(len(seen), 2, count)
    own = np.einsum("mik,mjk->mij", *[factor.reshape(len(seen), 2, -1)] * 2)
    rest = own - by_look @ by_look.transpose(0, 2, 1)
    return Errors((ways @ modes.T).reshape(len(ways), len(seen), 2), rest, weights)


def _shells(count: int, radii: Array) -> tuple[Array, Array]:
    """(S, count) points of a normal distribution, on shells of ascending radii, and (S,) their weights."""
    ways = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=count) if any(way)])
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    edges = np.concatenate([[0.0], (radii[:-1] + radii[1:]) / 2.0, [np.inf]])
    # The distance from the origin is chi distributed; scipy.stats says so too, and takes a second to import.
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
    seen: VisibilityInterval,
    errors: Errors,
    least_apart: float,
) -> Array:
    """(S, M) odds against the merge that each look gives, in each way in which the poses may be wrong.

    Args:
        seen: the looks.
        errors: the ways.
        least_apart: the robots' middles are never nearer than this, m.
    """
    draws = quadrature_points(seen.spreads + errors.rest)
    out: Array = np.array(
        [_odds(seen, seen.offsets[:, None] + shift[:, None] + draws, least_apart) for shift in errors.shifts]
    )
    return out


MISSED = 0.1
"""Share of looks, at most, in which the sensors miss a robot that stands in their way."""
SCENERY = 0.2
"""How often something else ends a ray where the robot would have been."""


def _odds(seen: VisibilityInterval, places: Array, least_apart: float) -> Array:
    """(M,) odds against the merge if the other one was equally likely at each of (M, D, 2) places, m."""
    went_on, ended = _outcomes(seen, places)
    possible = np.hypot(places[..., 0], places[..., 1]) >= least_apart
    on = (went_on & possible).sum(axis=1)
    there = (ended & ~went_on & possible).sum(axis=1)
    # A trace more: if no draw is possible, nothing is known.
    unknown = possible.sum(axis=1) - on - there + 1e-9
    without = unknown + (1.0 - SCENERY) * on + there
    out: Array = without / (unknown + MISSED * on + (1.0 - MISSED) / SCENERY * there)
    return out


CORE = 0.8
"""A ray surely meets a robot if it comes as near to its middle as this share of its radius: few robots are
round, but a square hides this much to four of five sides."""
MARGIN = 0.1
"""A ray went on if it is longer by more than this than where it would have met the robot, m."""
MARGIN_SHARE = 0.05
"""The same as a share of that distance."""


def _outcomes(seen: VisibilityInterval, places: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(M, D) whether a ray went on where it would have met the other one, and whether one ended there."""
    middles = places.mean(axis=1)
    wander = np.hypot(*(places - middles[:, None]).transpose(2, 0, 1)).max(axis=1)
    u, middle = seen.directions, middles[seen.looks]
    across = np.abs(u[:, 0] * middle[:, 1] - u[:, 1] * middle[:, 0])
    along = (u * middle).sum(axis=1)
    reach = (CORE * seen.radii + wander)[seen.looks]
    may_meet = np.flatnonzero((across < reach) & (along > -reach) & (seen.lengths > along - 2.0 * reach))
    looks, u, lengths = seen.looks[may_meet], u[may_meet], seen.lengths[may_meet, None]
    x, y = places[looks, :, 0], places[looks, :, 1]
    along = u[:, :1] * x + u[:, 1:] * y
    across2 = (u[:, :1] * y - u[:, 1:] * x) ** 2
    radii = seen.radii[looks, None]
    core = (CORE * radii) ** 2 - across2
    meets = (core > 0.0) & (along > 0.0)
    first = along - np.sqrt(np.maximum(radii**2 - across2, 0.0))
    last = along - np.sqrt(np.maximum(core, 0.0))
    margins = MARGIN + MARGIN_SHARE * last
    free = meets & (lengths >= first - margins)
    beyond = free & (lengths > last + margins)
    shape = places.shape[:2]
    went_on, ended = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    if len(looks):
        starts = np.flatnonzero(np.diff(looks, prepend=-1))
        went_on[looks[starts]] = np.logical_or.reduceat(beyond, starts, axis=0)
        ended[looks[starts]] = np.logical_or.reduceat(free & ~beyond, starts, axis=0)
    return went_on, ended
