"""Physical exclusion: two robots are never at the same place at the same time.

Two rooms that look exactly the same cannot be told apart by images. But a robot has a footprint. Under a
merge that takes one room for the other, robots that were in both at the same time drive through each other.

Nodes give a robot's pose at their times; in between it is somewhere near the straight line. So for each
moment there is a probability that the two footprints did not overlap. If only the footprints are evidence,
this is the likelihood ratio of a true merge over a false one (up to the area of a footprint). The odds of
independent moments multiply, and under a true merge their product exceeds N with a probability of at most
1/N, however often it is tested (Ville's inequality; Grünwald et al., "Safe testing", 2024).

Robots are also seen: the odds of `mapweave.merge.mutual_exclusion.mutual_visibility` are multiplied with
these.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.merge.mutual_exclusion.collision import Collision
from mapweave.merge.mutual_exclusion.encounter import Encounter
from mapweave.merge.mutual_exclusion.mutual_visibility import errors_in_common, none_wrong, odds_against
from mapweave.merge.mutual_exclusion.quadrature import SAMPLES, quadrature_points
from mapweave.merge.mutual_exclusion.trajectories import RobotTrajectory, Stay, stay
from mapweave.merge.mutual_exclusion.visibility_intervals import visibility_intervals
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ExclusionSettings

SIGMAS = 2.0
"""The poses of the two are first moved apart by this many standard deviations, since their errors are common
to all moments."""


def collision_of(
    graph: PoseGraph,
    first: RobotTrajectory,
    second: RobotTrajectory,
    settings: ExclusionSettings | None = None,
) -> Collision | None:
    """Whether two robots' trajectories contradict each other.

    Args:
        graph: the merged component that holds the nodes of both.
        first: of one robot.
        second: of another one: one robot's own trajectories never collide.
        settings: when they do.

    Returns:
        The collision, or None if there is none, or nothing is known: other clocks, other times.
    """
    s = settings or ExclusionSettings()
    met = _met(graph, first, second, s)
    if met is None:
        return None
    # Covariances cost more than all the rest: they are computed only if the poses as they are collide.
    meeting, clear, odds, still = met.meeting, met.clear, met.odds, np.ones(1)
    if not meeting.refuses(clear, odds, still, s):
        return None
    # Nor for all observations, where the first of them are enough.
    ample = meeting.ample(clear, odds, s)
    by_footprints, by_visibility = meeting.evidence(clear, odds, still)
    close, least_apart = meeting.close, meeting.least_apart
    shift = SIGMAS * _pose_sigmas(graph, first, second, met.one.nearest[close], met.two.nearest[close])
    clear = chances_clear(met.apart, shift, met.spreads, least_apart)
    for some in sorted({ample, len(meeting.times)}):
        part = replace(meeting, seen=meeting.seen.take(meeting.seen.moments < some))
        errors = errors_in_common(graph, part.seen) if len(part.seen) else none_wrong(part.seen)
        moved = odds_against(part.seen, errors, least_apart)
        if part.refuses(clear, moved, errors.weights, s):
            evidence = sum(part.evidence(clear, moved, errors.weights))
            return _collision(
                graph, (first, second), meeting, odds[0] if by_visibility > by_footprints else None, evidence
            )
    return None


@dataclass(frozen=True, eq=False)
class _Met:
    """Two robots that came near each other, with their poses as they are.

    Attributes:
        meeting: when.
        apart: (K, 2) m, from the first to the second robot in the moments that are close.
        spreads: (K, 2, 2) m^2, covariance of `apart`.
        clear: (K,) chances that they were clear of each other after all.
        odds: (1, M) against the merge, of each observation.
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
    graph: PoseGraph, first: RobotTrajectory, second: RobotTrajectory, s: ExclusionSettings
) -> _Met | None:
    """None if they are not known to have met."""
    start, end = max(first.times[0], second.times[0]), min(first.times[-1], second.times[-1])
    if first.clock != second.clock or first.agent == second.agent or start > end:
        return None
    grid = np.arange(math.ceil(start / STEP), math.floor(end / STEP) + 1) * STEP
    times = np.unique(np.concatenate([first.times, second.times, grid]))
    times = times[(times >= start) & (times <= end)]
    first_poses, second_poses = first.poses(graph), second.poses(graph)
    first_stay, second_stay = stay(first, first_poses[:, :2], times), stay(second, second_poses[:, :2], times)
    radii_known = first.radius > 0.0 and second.radius > 0.0
    least_apart = first.radius + second.radius if radii_known else s.least_apart
    both_known = first_stay.known & second_stay.known
    apart = second_stay.places - first_stay.places
    distances = np.hypot(apart[:, 0], apart[:, 1])
    close = np.flatnonzero(both_known & (distances < least_apart))
    intervals = visibility_intervals(
        graph, first, first_poses, second, second_stay, times
    ) + visibility_intervals(graph, second, second_poses, first, first_stay, times)
    if len(close) == 0 and len(intervals) == 0:
        return None
    spreads = (first_stay.spreads + second_stay.spreads)[close]
    clear = chances_clear(apart[close], np.zeros(len(close)), spreads, least_apart)
    odds = odds_against(intervals, none_wrong(intervals), least_apart)
    meeting = Encounter(times, both_known, distances, close, intervals, least_apart)
    return _Met(meeting, apart[close], spreads, clear, odds, first_stay, second_stay)


def _collision(
    graph: PoseGraph,
    trajectories: tuple[RobotTrajectory, RobotTrajectory],
    meeting: Encounter,
    odds: Array | None,
    evidence: float,
) -> Collision:
    """Its numbers: by visibility if (M,) odds against the merge are given, else by footprints."""
    first, second = trajectories
    if odds is None:
        worst = meeting.close[np.argmin(meeting.distances[meeting.close])]
        return Collision(
            first.agent, second.agent, first.clock, len(meeting.close), float(meeting.distances[worst]),
            float(meeting.times[worst]), evidence,
        )  # fmt: skip
    intervals = meeting.seen
    against = np.flatnonzero(odds > 2.0)
    ways = np.hypot(intervals.offsets[:, 0], intervals.offsets[:, 1])
    worst = against[np.lexsort([ways[against], -odds[against].round(1)])[0]]
    agents = [graph.nodes[row[worst]].agent for row in (intervals.observers, intervals.others)]
    x, y = intervals.offsets[worst]
    bearing = math.remainder(math.atan2(y, x) - intervals.headings[worst], math.tau)
    side = ("ahead", "to its left", "behind", "to its right")[round(bearing / (math.pi / 2)) % 4]
    return Collision(
        agents[0], agents[1], first.clock, len(against), float(ways[worst]),
        float(meeting.times[intervals.moments[worst]]), evidence, side,
    )  # fmt: skip


def _pose_sigmas(
    graph: PoseGraph,
    first: RobotTrajectory,
    second: RobotTrajectory,
    i: NDArray[np.int64],
    j: NDArray[np.int64],
) -> Array:
    """(K,) m, standard deviation of the offset between nodes i and j in the worst direction."""
    pairs, seat = np.unique(np.stack([i, j], axis=1), axis=0, return_inverse=True)
    relative = graph.relative([first.nodes[k] for k in pairs[:, 0]], [second.nodes[k] for k in pairs[:, 1]])
    out: Array = np.sqrt(np.linalg.eigvalsh(relative.covariances[:, :2, :2])[:, -1])[seat.ravel()]
    return out


def chances_clear(apart: Array, shift: Array, spreads: Array, least_apart: float) -> Array:
    """(K,) chances that two robots are clear of each other after all.

    Args:
        apart: (K, 2) m, from the first to the second robot.
        shift: (K,) m, they are first moved further apart by this.
        spreads: (K, 2, 2) m^2, covariance of `apart`.
        least_apart: m.
    """
    distances = np.hypot(apart[:, 0], apart[:, 1])[:, None]
    outwards = np.where(distances > 1e-9, apart / np.maximum(distances, 1e-9), [1.0, 0.0])
    places = (apart + shift[:, None] * outwards)[:, None, :] + quadrature_points(spreads)
    clear = (np.hypot(places[..., 0], places[..., 1]) >= least_apart).sum(axis=1)
    # One more on both sides: an event in none of 64 samples is not impossible.
    out: Array = (clear + 1.0) / (len(SAMPLES) + 1.0)
    return out
