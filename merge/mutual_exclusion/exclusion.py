"""Physical exclusion: two robots are never at the same place at the same time.

Two rooms that look exactly alike are told apart by nothing that is seen. But a robot is a body. Under a merge
that takes the one room for the other, robots that were in both at the same time walk through each other.

Nodes say where a robot was when; in between it is somewhere about the straight line. So what is known of a
moment is not a distance but a chance that the two bodies were clear of each other after all. If nothing but
their bodies keeps two robots apart, this chance is how likely a true merge makes what was measured, as a
share of how likely a false one makes it (but for the ground that a body takes). The odds of moments that are
independent multiply, and a true merge drives their product beyond N with a chance of at most 1/N, however
often it is looked at (Ville's inequality; Grünwald et al., "Safe testing", 2024).

Bodies are also seen: what `mapweave.merge.mutual_exclusion.mutual_visibility` makes of it is multiplied with
this. So is what the robots' cameras should have seen of each other's maps
(`mapweave.merge.mutual_exclusion.negative_evidence`), where the bodies speak against the merge, but not
loudly enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.merge.mutual_exclusion.collision import Collision
from mapweave.merge.mutual_exclusion.encounter import Encounter
from mapweave.merge.mutual_exclusion.mutual_visibility import errors_in_common, none_wrong, odds_against
from mapweave.merge.mutual_exclusion.negative_evidence import MOST, negative_evidence
from mapweave.merge.mutual_exclusion.quadrature import DRAWS, quadrature_points
from mapweave.merge.mutual_exclusion.trajectories import BodyTrajectory, Stay, stay
from mapweave.merge.mutual_exclusion.visibility_intervals import visibility_intervals
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ExclusionSettings

SIGMAS = 2.0
"""The poses of the two are first moved apart by as many standard deviations, since what is wrong with them
is wrong at all moments alike."""


def clash_of(
    graph: PoseGraph, first: BodyTrajectory, second: BodyTrajectory, settings: ExclusionSettings | None = None
) -> Collision | None:
    """Whether two robots' trails contradict each other.

    Args:
        graph: the merged component that holds the nodes of both.
        first: of one robot.
        second: of another one: one robot's own trails are one body and never clash.
        settings: when they do.

    Returns:
        The clash, or None if there is none, or nothing is known: other clocks, other times.
    """
    s = settings or ExclusionSettings()
    met = _met(graph, first, second, s)
    if met is None:
        return None
    # Covariances cost more than all the rest, and views more than the sensors: they are asked for only if the
    # poses as they are clash, as far as that could be enough.
    meeting, clear, odds, still = met.meeting, met.clear, met.odds, np.ones(1)
    if not meeting.refuses(clear, odds, still, s, math.log(MOST)):
        return None
    # Nor for all looks, where the first of them are ample.
    ample = meeting.ample(clear, odds, s)
    bodies, sight = meeting.evidence(clear, odds, still, s)
    close, least_apart = meeting.close, meeting.least_apart
    shift = SIGMAS * _pose_sigmas(graph, first, second, met.one.nearest[close], met.two.nearest[close])
    clear = chances_clear(met.apart, shift, met.spreads, least_apart)
    for some in sorted({ample, len(meeting.times)}):
        part = replace(meeting, seen=meeting.seen.take(meeting.seen.moments < some))
        errors = errors_in_common(graph, part.seen) if len(part.seen) else none_wrong(part.seen)
        moved = odds_against(part.seen, errors, least_apart)
        if part.refuses(clear, moved, errors.weights, s):
            evidence = sum(part.evidence(clear, moved, errors.weights, s))
            return _clash(graph, (first, second), meeting, odds[0] if sight > bodies else None, evidence)
    if not part.refuses(clear, moved, errors.weights, s, math.log(MOST)):
        return None
    views = negative_evidence(graph, first, second)
    absent = views.evidence()
    if not part.refuses(clear, moved, errors.weights, s, absent):
        return None
    evidence = sum(part.evidence(clear, moved, errors.weights, s)) + absent
    clash = _clash(graph, (first, second), meeting, odds[0] if sight > bodies else None, evidence)
    return replace(clash, blank=int(views.show_nothing().sum()))


@dataclass(frozen=True, eq=False)
class _Met:
    """Two robots that came near each other, with their poses as they are.

    Attributes:
        meeting: when.
        apart: (K, 2) m, from the one to the other in the moments that are close.
        spreads: (K, 2, 2) m^2, covariance of `apart`.
        clear: (K,) chances that they were clear of each other after all.
        odds: (1, M) against the merge, of each look.
        one: where the first one was.
        two: where the second one was.
    """

    meeting: Encounter
    apart: Array
    spreads: Array
    clear: Array
    odds: Array
    one: Stay
    two: Stay


STEP = 0.5
"""Moments between nodes are looked at as often as this, s."""


def _met(
    graph: PoseGraph, first: BodyTrajectory, second: BodyTrajectory, s: ExclusionSettings
) -> _Met | None:
    """None if they never met, as far as anybody knows."""
    start, end = max(first.times[0], second.times[0]), min(first.times[-1], second.times[-1])
    if first.clock != second.clock or first.agent == second.agent or start > end:
        return None
    grid = np.arange(math.ceil(start / STEP), math.floor(end / STEP) + 1) * STEP
    times = np.unique(np.concatenate([first.times, second.times, grid]))
    times = times[(times >= start) & (times <= end)]
    one, two = (stay(trail, trail.poses(graph)[:, :2], times) for trail in (first, second))
    told = first.radius > 0.0 and second.radius > 0.0
    least_apart = first.radius + second.radius if told else s.least_apart
    known = one.known & two.known
    apart = two.places - one.places
    distances = np.hypot(apart[:, 0], apart[:, 1])
    close = np.flatnonzero(known & (distances < least_apart))
    seen = visibility_intervals(graph, first, second, two, times) + visibility_intervals(
        graph, second, first, one, times
    )
    if len(close) == 0 and len(seen) == 0:
        return None
    spreads = (one.spreads + two.spreads)[close]
    clear = chances_clear(apart[close], np.zeros(len(close)), spreads, least_apart)
    odds = odds_against(seen, none_wrong(seen), least_apart)
    meeting = Encounter(times, known, distances, close, seen, least_apart)
    return _Met(meeting, apart[close], spreads, clear, odds, one, two)


def _clash(
    graph: PoseGraph,
    trails: tuple[BodyTrajectory, BodyTrajectory],
    meeting: Encounter,
    odds: Array | None,
    evidence: float,
) -> Collision:
    """In numbers: by sight if (M,) odds against the merge of the looks are given, else by bodies."""
    first, second = trails
    if odds is None:
        worst = meeting.close[np.argmin(meeting.distances[meeting.close])]
        return Collision(
            first.agent, second.agent, first.clock, len(meeting.close), float(meeting.distances[worst]),
            float(meeting.times[worst]), evidence,
        )  # fmt: skip
    seen = meeting.seen
    against = np.flatnonzero(odds > 2.0)
    ways = np.hypot(seen.offsets[:, 0], seen.offsets[:, 1])
    worst = against[np.lexsort([ways[against], -odds[against].round(1)])[0]]
    agents = [graph.nodes[row[worst]].agent for row in (seen.observers, seen.others)]
    x, y = seen.offsets[worst]
    bearing = math.remainder(math.atan2(y, x) - seen.headings[worst], math.tau)
    side = ("ahead", "to its left", "behind", "to its right")[round(bearing / (math.pi / 2)) % 4]
    return Collision(
        agents[0], agents[1], first.clock, len(against), float(ways[worst]),
        float(meeting.times[seen.moments[worst]]), evidence, side,
    )  # fmt: skip


def _pose_sigmas(
    graph: PoseGraph,
    first: BodyTrajectory,
    second: BodyTrajectory,
    i: NDArray[np.int64],
    j: NDArray[np.int64],
) -> Array:
    """(K,) m, standard deviation of how nodes i and j of two trails are apart, in the worst direction."""
    pairs, seat = np.unique(np.stack([i, j], axis=1), axis=0, return_inverse=True)
    relative = graph.relative([first.nodes[k] for k in pairs[:, 0]], [second.nodes[k] for k in pairs[:, 1]])
    out: Array = np.sqrt(np.linalg.eigvalsh(relative.covariances[:, :2, :2])[:, -1])[seat.ravel()]
    return out


def chances_clear(apart: Array, shift: Array, spreads: Array, least_apart: float) -> Array:
    """(K,) chances that two robots are clear of each other after all.

    Args:
        apart: (K, 2) m, from the one to the other.
        shift: (K,) m, they are first moved further apart by this.
        spreads: (K, 2, 2) m^2, covariance of `apart`.
        least_apart: m.
    """
    distances = np.hypot(apart[:, 0], apart[:, 1])[:, None]
    outwards = np.where(distances > 1e-9, apart / np.maximum(distances, 1e-9), [1.0, 0.0])
    places = (apart + shift[:, None] * outwards)[:, None, :] + quadrature_points(spreads)
    clear = (np.hypot(places[..., 0], places[..., 1]) >= least_apart).sum(axis=1)
    # One more on both sides: what 64 draws do not show is not impossible.
    out: Array = (clear + 1.0) / (len(DRAWS) + 1.0)
    return out
