"""Physical exclusion: two robots are never at the same place at the same time.

Two rooms that look exactly alike are told apart by nothing that is seen. But a robot is a body. Under a merge
that takes the one room for the other, robots that were in both at the same time walk through each other.

Nodes say where a robot was when; in between it is somewhere about the straight line. So what is known of a
moment is not a distance but a chance that the two bodies were clear of each other after all. If nothing but
their bodies keeps two robots apart, this chance is how likely a true merge makes what was measured, as a
share of how likely a false one makes it (but for the ground that a body takes). The odds of moments that are
independent multiply, and a true merge drives their product beyond N with a chance of at most 1/N, however
often it is looked at (Ville's inequality; Grünwald et al., "Safe testing", 2024).

Bodies are also seen: what `merge.bodies.sight` makes of it is multiplied with this. So is what the robots'
cameras should have seen of each other's maps (`merge.bodies.absence`), where the bodies speak against the
merge, but not loudly enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.special
from numpy.typing import NDArray

from hybridmap.pose import Array
from merge.bodies.absence import AbsenceSettings, absence
from merge.bodies.clash import Clash
from merge.bodies.draws import DRAWS, drawn
from merge.bodies.looking import Looking, looking
from merge.bodies.sight import SightSettings, errors_in_common, none_wrong, odds_against
from merge.bodies.trails import Trail, TrailSettings, stay
from merge.graph.posegraph import PoseGraph


@dataclass(frozen=True)
class ExclusionSettings:
    """When two robots contradict each other's postures.

    Attributes:
        least_apart: centres of two robots are never nearer than this, m, unless both tell their radii: with
            a camera and two driven wheels few are narrower.
        doubt: chance at most that a true merge is refused, ever.
        least_witnesses: independent moments (see `window`) that must make the merge half as likely each.
        sigmas: the postures of the two are first moved apart by as many standard deviations, since what is
            wrong with them is wrong at all moments alike.
        step: moments between nodes are looked at as often as this, s.
        window: moments within as much time are one witness, s.
        neighbourhood: robots that are further apart than as many least distances speak neither for nor
            against.
        trail: how well it is known where a robot is between two nodes.
        sight: what robots should have seen of each other.
        absence: what they should have seen of each other's maps.
    """

    least_apart: float = 0.2
    doubt: float = 1e-3
    least_witnesses: int = 3
    sigmas: float = 2.0
    step: float = 0.5
    window: float = 2.0
    neighbourhood: float = 5.0
    trail: TrailSettings = field(default_factory=TrailSettings)
    sight: SightSettings = field(default_factory=SightSettings)
    absence: AbsenceSettings = field(default_factory=AbsenceSettings)


def clash_of(
    graph: PoseGraph, first: Trail, second: Trail, settings: ExclusionSettings | None = None
) -> Clash | None:
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
    start, end = max(first.times[0], second.times[0]), min(first.times[-1], second.times[-1])
    if first.clock != second.clock or first.agent == second.agent or start > end:
        return None
    grid = np.arange(math.ceil(start / s.step), math.floor(end / s.step) + 1) * s.step
    times = np.unique(np.concatenate([first.times, second.times, grid]))
    times = times[(times >= start) & (times <= end)]
    one, two = (stay(trail, trail.postures(graph)[:, :2], times, s.trail) for trail in (first, second))
    told = first.radius > 0.0 and second.radius > 0.0
    least_apart = first.radius + second.radius if told else s.least_apart
    known = one.known & two.known
    apart = two.places - one.places
    distances = np.hypot(apart[:, 0], apart[:, 1])
    close = np.flatnonzero(known & (distances < least_apart))
    seen = looking(graph, first, second, two, times) + looking(graph, second, first, one, times)
    if len(close) == 0 and len(seen) == 0:
        return None
    spreads = (one.spreads + two.spreads)[close]
    meeting = _Meeting(times, known, distances, close, seen, least_apart)
    # Covariances cost more than all the rest, and views more than the sensors: they are asked for only if the
    # postures as they are clash, as far as that could be enough.
    clear = chances_clear(apart[close], np.zeros(len(close)), spreads, least_apart)
    still = none_wrong(seen)
    odds = odds_against(seen, still, least_apart, s.sight)
    if not meeting.refuses(clear, odds, still.weights, s, math.log(s.absence.most)):
        return None
    # Nor for all looks, where the first of them are ample.
    ample = meeting.ample(clear, odds, s)
    bodies, sight = meeting.evidence(clear, odds, still.weights, s)
    shift = s.sigmas * _posture_sigmas(graph, first, second, one.nearest[close], two.nearest[close])
    clear = chances_clear(apart[close], shift, spreads, least_apart)
    for some in sorted({ample, len(times)}):
        part = replace(meeting, seen=seen.take(seen.moments < some))
        errors = errors_in_common(graph, part.seen, s.sight) if len(part.seen) else none_wrong(part.seen)
        moved = odds_against(part.seen, errors, least_apart, s.sight)
        if part.refuses(clear, moved, errors.weights, s):
            evidence = sum(part.evidence(clear, moved, errors.weights, s))
            return _clash(graph, (first, second), meeting, odds[0] if sight > bodies else None, evidence)
    if not part.refuses(clear, moved, errors.weights, s, math.log(s.absence.most)):
        return None
    views = absence(graph, first, second, s.absence)
    absent = views.evidence(s.absence)
    if not part.refuses(clear, moved, errors.weights, s, absent):
        return None
    evidence = sum(part.evidence(clear, moved, errors.weights, s)) + absent
    clash = _clash(graph, (first, second), meeting, odds[0] if sight > bodies else None, evidence)
    return replace(clash, blank=int(views.show_nothing(s.absence).sum()))


@dataclass(frozen=True, eq=False)
class _Meeting:
    """Moments of two robots.

    Attributes:
        times: (T,) s.
        known: (T,) whether both are known to be somewhere.
        distances: (T,) m, between them.
        close: (K,) indices of moments when they are too near.
        seen: M looks at where the other one would have been.
        least_apart: what is too near, m.
    """

    times: Array
    known: NDArray[np.bool_]
    distances: Array
    close: NDArray[np.int64]
    seen: Looking
    least_apart: float

    def _windows(self, s: ExclusionSettings) -> NDArray[np.int64]:
        """(T,) number of the window of time in which a moment is; -1 where it is not known of both."""
        windows = np.floor(self.times / s.window).astype(np.int64)
        _, seats = np.unique(windows[self.known], return_inverse=True)
        out = np.full(len(windows), -1, np.int64)
        out[self.known] = seats
        return out

    def by_bodies(self, clear: Array, s: ExclusionSettings) -> Array:
        """(W,) logarithms of the odds against the merge that each window of time gives.

        Args:
            clear: (K,) chances that they were clear of each other after all in the moments that are close.
            s: how long a window is.
        """
        # A body takes this share of the neighbourhood; without it many moments would prove anything.
        free = 1.0 - s.neighbourhood**-2
        odds = np.where(self.distances < s.neighbourhood * self.least_apart, free, 1.0)
        odds[self.close] = free / clear
        seats = self._windows(s)[self.known]
        # Moments of one window hang together: the mean of their odds is fair all the same, a product is not.
        out: Array = np.log(np.bincount(seats, odds[self.known]) / np.bincount(seats))
        return out

    def by_sight(self, odds: Array, s: ExclusionSettings) -> Array:
        """(S, W) the same of what they should have seen.

        Args:
            odds: (S, M) against the merge, of each look.
            s: how long a window is.
        """
        seats = self._windows(s)
        looks, count = seats[self.seen.moments], int(seats.max()) + 1
        counts = np.bincount(looks, minlength=count)
        sums = np.array([np.bincount(looks, row, minlength=count) for row in odds])
        out: Array = np.log(np.where(counts > 0, sums / np.maximum(counts, 1), 1.0))
        return out

    def refuses(
        self, clear: Array, odds: Array, weights: Array, s: ExclusionSettings, besides: float = 0.0
    ) -> bool:
        """Whether that is enough to refuse a merge.

        Args:
            clear: as in `by_bodies`.
            odds: as in `by_sight`.
            weights: (S,) how probable each way is in which postures may be wrong.
            s: what is enough.
            besides: natural logarithm of the odds against the merge that other evidence gives.
        """
        by_window, total = self._added(clear, odds, weights, s)
        # What was enough at any time is enough: later meetings do not make it possible.
        witnesses = np.cumsum(by_window > math.log(2.0))
        return bool(((witnesses >= s.least_witnesses) & (total + besides >= -math.log(s.doubt))).any())

    def _added(self, clear: Array, odds: Array, weights: Array, s: ExclusionSettings) -> tuple[Array, Array]:
        """(W,) logarithms of the odds against the merge that each window adds to those before, and (W,) sums.

        Over all ways in which postures may be wrong, each as probable as it is: the later windows meet those
        that the earlier ones have left.
        """
        by_way = np.cumsum(self.by_bodies(clear, s) + self.by_sight(odds, s), axis=1)
        total: Array = -scipy.special.logsumexp(-by_way, axis=0, b=weights[:, None])
        added: Array = np.diff(total, prepend=0.0)
        return added, total

    def evidence(
        self, clear: Array, odds: Array, weights: Array, s: ExclusionSettings
    ) -> tuple[float, float]:
        """By bodies and by sight, when it was most."""
        by_bodies = np.cumsum(self.by_bodies(clear, s))
        _, total = self._added(clear, odds, weights, s)
        most = int(np.argmax(total))
        return float(by_bodies[most]), float(total[most] - by_bodies[most])

    def ample(self, clear: Array, odds: Array, s: ExclusionSettings) -> int:
        """Number of moments after which there is twice as much evidence as is asked for; all, if never."""
        evidence = np.cumsum(self.by_bodies(clear, s) + self.by_sight(odds, s)[0])
        enough = np.flatnonzero(evidence >= -2.0 * math.log(s.doubt))
        seats = self._windows(s)
        return int(np.flatnonzero(seats == enough[0])[-1]) + 1 if len(enough) else len(seats)


def _clash(
    graph: PoseGraph, trails: tuple[Trail, Trail], meeting: _Meeting, odds: Array | None, evidence: float
) -> Clash:
    """In numbers: by sight if (M,) odds against the merge of the looks are given, else by bodies."""
    first, second = trails
    if odds is None:
        worst = meeting.close[np.argmin(meeting.distances[meeting.close])]
        return Clash(
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
    return Clash(
        agents[0], agents[1], first.clock, len(against), float(ways[worst]),
        float(meeting.times[seen.moments[worst]]), evidence, side,
    )  # fmt: skip


def _posture_sigmas(
    graph: PoseGraph, first: Trail, second: Trail, i: NDArray[np.int64], j: NDArray[np.int64]
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
    places = (apart + shift[:, None] * outwards)[:, None, :] + drawn(spreads)
    clear = (np.hypot(places[..., 0], places[..., 1]) >= least_apart).sum(axis=1)
    # One more on both sides: what 64 draws do not show is not impossible.
    out: Array = (clear + 1.0) / (len(DRAWS) + 1.0)
    return out
