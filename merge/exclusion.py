"""Physical exclusion: two robots are never at the same place at the same time.

Two rooms that look exactly alike are told apart by nothing that is seen. But a robot is a body. Under a merge
that takes the one room for the other, robots that were in both at the same time walk through each other.

Nodes say where a robot was when; in between it is somewhere about the straight line. So what is known of a
moment is not a distance but a chance that the two bodies were clear of each other after all. If nothing but
their bodies keeps two robots apart, this chance is how likely a true merge makes what was measured, as a
share of how likely a false one makes it (but for the ground that a body takes). The odds of moments that are
independent multiply, and a true merge drives their product beyond N with a chance of at most 1/N, however
often it is looked at (Ville's inequality; Grünwald et al., "Safe testing", 2024).
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.node import Node, NodeId
from hybridmap.pose import Array
from merge.posegraph import PoseGraph

NANOSECONDS = 1e9


@dataclass(frozen=True)
class ExclusionSettings:
    """When two robots contradict each other's postures.

    Attributes:
        least_apart: centres of two robots are never nearer than this, m: with a camera and two driven wheels
            none is narrower. Nodes that name the robots' radii tell more.
        doubt: chance at most that a true merge is refused, ever.
        least_witnesses: independent moments (see `window`) that must make the merge half as likely each.
        sigmas: the postures of the two are first moved apart by as many standard deviations, since what is
            wrong with them is wrong at all moments alike.
        longest_gap: between two nodes that are further apart in time nobody knows where the robot was, s.
        longest_way: nor if they are further apart, m.
        along: how far ahead or behind on the line between two nodes a robot may be midway, as a share of the
            line, standard deviation: it stops and goes.
        aside: the same to the side of the line.
        clock_error: of two robots with the same clock, s.
        step: moments between nodes are looked at as often as this, s.
        window: moments within as much time are one witness, s.
        neighbourhood: robots that are further apart than this speak neither for nor against, m.
    """

    least_apart: float = 0.2
    doubt: float = 1e-3
    least_witnesses: int = 3
    sigmas: float = 2.0
    longest_gap: float = 5.2
    longest_way: float = 1.0
    along: float = 0.15
    aside: float = 0.05
    clock_error: float = 0.05
    step: float = 0.5
    window: float = 2.0
    neighbourhood: float = 1.0


@dataclass(frozen=True, eq=False)
class Trail:
    """When a robot was at which node, by one clock.

    Attributes:
        clock: not empty.
        nodes: N, in the order of their stamps.
        times: (N,) s, ascending.
        radius: of the robot, m; 0 if not all nodes tell.
    """

    clock: str
    nodes: tuple[NodeId, ...]
    times: Array
    radius: float = 0.0

    @property
    def agent(self) -> str:
        """Whose it is."""
        return self.nodes[0].agent


@dataclass(frozen=True)
class Clash:
    """Two robots that would have been at the same place at the same time.

    Attributes:
        first: agent.
        second: another one.
        clock: that says so.
        moments: how many moments they would have been too near.
        nearest: how near they would have been, m.
        time: when that was, s.
        evidence: natural logarithm of the odds against the merge.
    """

    first: str
    second: str
    clock: str
    moments: int
    nearest: float
    time: float
    evidence: float

    @property
    def reason(self) -> str:
        """In words."""
        return (
            f"{self.first} and {self.second} would have been at the same place at the same time: "
            f"{self.nearest:.2f} m apart at {self.time:.1f} s of clock {self.clock}, "
            f"{self.moments} such moments"
        )


def trails_of(nodes: Collection[Node]) -> tuple[Trail, ...]:
    """The trails of one robot's nodes, one a clock; nodes whose clock nobody knows are left out."""
    by_clock: dict[str, list[Node]] = {}
    for node in nodes:
        if node.clock:
            by_clock.setdefault(node.clock, []).append(node)
    trails = []
    for clock, known in sorted(by_clock.items()):
        known.sort(key=lambda node: (node.stamp_ns, node.id))
        times = np.array([node.stamp_ns for node in known]) / NANOSECONDS
        radius = min(node.radius for node in known)
        trails.append(Trail(clock, tuple(node.id for node in known), times, radius))
    return tuple(trails)


@dataclass(frozen=True, eq=False)
class _Stay:
    """Where a robot was at some moments.

    Attributes:
        known: (T,) whether anybody knows.
        places: (T, 2) m, in the component's frame.
        spreads: (T, 2, 2) m^2, because the robot wanders between its nodes.
        nearest: (T,) index of the node of the trail that is nearest in time.
    """

    known: NDArray[np.bool_]
    places: Array
    spreads: Array
    nearest: NDArray[np.int64]


def _stay(trail: Trail, places: Array, times: Array, s: ExclusionSettings) -> _Stay:
    """Where a robot with nodes at `places`, (N, 2) m, was at `times`, (T,) s."""
    before = np.clip(np.searchsorted(trail.times, times, side="right") - 1, 0, max(len(places) - 2, 0))
    after = np.minimum(before + 1, len(places) - 1)
    gaps = np.maximum(trail.times[after] - trail.times[before], 1e-9)
    lines = places[after] - places[before]
    lengths = np.hypot(lines[:, 0], lines[:, 1])
    share = np.clip((times - trail.times[before]) / gaps, 0.0, 1.0)
    at_node = (share == 0.0) | (share == 1.0)
    known = (times >= trail.times[0]) & (times <= trail.times[-1])
    known &= at_node | ((gaps <= s.longest_gap) & (lengths <= s.longest_way))
    bow = 4.0 * share * (1.0 - share) * lengths
    ahead = lines / np.maximum(lengths, 1e-9)[:, None]
    along2 = (s.along * bow) ** 2 + (s.clock_error * lengths / gaps) ** 2
    aside2 = (s.aside * bow) ** 2
    outer = ahead[:, :, None] * ahead[:, None, :]
    spreads = (along2 - aside2)[:, None, None] * outer + aside2[:, None, None] * np.eye(2)
    nearest = np.where(share < 0.5, before, after)
    return _Stay(known, places[before] + share[:, None] * lines, spreads, nearest)


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
    one, two = (
        _stay(trail, graph.means[graph.index(trail.nodes), :2], times, s) for trail in (first, second)
    )
    least_apart = max(s.least_apart, first.radius + second.radius)
    known = one.known & two.known
    apart = two.places - one.places
    distances = np.hypot(apart[:, 0], apart[:, 1])
    close = np.flatnonzero(known & (distances < least_apart))
    if len(close) == 0:
        return None
    shift = s.sigmas * _posture_sigmas(graph, first, second, one.nearest[close], two.nearest[close])
    clear = chances_clear(apart[close], shift, (one.spreads + two.spreads)[close], least_apart)
    # A body takes this share of the neighbourhood; without it many moments would prove anything.
    free = 1.0 - (least_apart / s.neighbourhood) ** 2
    odds = np.where(distances < s.neighbourhood, free, 1.0)
    odds[close] = free / clear
    witness = np.floor(times[known] / s.window).astype(np.int64)
    _, seat, counts = np.unique(witness, return_inverse=True, return_counts=True)
    # Moments of one window hang together: the mean of their odds is fair whatever ties them, a product not.
    evidence = np.log(np.bincount(seat, odds[known]) / counts)
    if (evidence > math.log(2.0)).sum() < s.least_witnesses or evidence.sum() < -math.log(s.doubt):
        return None
    worst = close[np.argmin(distances[close])]
    return Clash(
        first.agent, second.agent, first.clock, len(close), float(distances[worst]), float(times[worst]),
        float(evidence.sum()),
    )  # fmt: skip


def _posture_sigmas(
    graph: PoseGraph, first: Trail, second: Trail, i: NDArray[np.int64], j: NDArray[np.int64]
) -> Array:
    """(K,) m, standard deviation of how nodes i and j of two trails are apart, in the worst direction."""
    pairs, seat = np.unique(np.stack([i, j], axis=1), axis=0, return_inverse=True)
    relative = graph.relative([first.nodes[k] for k in pairs[:, 0]], [second.nodes[k] for k in pairs[:, 1]])
    out: Array = np.sqrt(np.linalg.eigvalsh(relative.covariances[:, :2, :2])[:, -1])[seat.ravel()]
    return out


def _evenly_spread() -> Array:
    """(64, 2) equally likely points of a normal distribution in the plane: eight rings of eight."""
    radii = np.sqrt(-2.0 * np.log(1.0 - (np.arange(8) + 0.5) / 8))
    angles = 2 * math.pi * (np.arange(8)[None] + 0.5 * (np.arange(8)[:, None] % 2)) / 8
    points = np.stack([radii[:, None] * np.cos(angles), radii[:, None] * np.sin(angles)], axis=-1)
    flat = points.reshape(-1, 2)
    out: Array = flat / flat.std(axis=0)
    return out


DRAWS = _evenly_spread()
LEAST_SPREAD = 0.01
"""Nobody's place is known better than this, m."""


def chances_clear(apart: Array, shift: Array, spreads: Array, least_apart: float) -> Array:
    """(K,) chances that two robots are at least so far apart after all.

    Args:
        apart: (K, 2) m, from the one to the other.
        shift: (K,) m, they are first moved further apart by this.
        spreads: (K, 2, 2) m^2, covariance of `apart`.
        least_apart: m.
    """
    distances = np.hypot(apart[:, 0], apart[:, 1])[:, None]
    outwards = np.where(distances > 1e-9, apart / np.maximum(distances, 1e-9), [1.0, 0.0])
    roots = np.linalg.cholesky(spreads + LEAST_SPREAD**2 * np.eye(2))
    places = (apart + shift[:, None] * outwards)[:, None, :] + DRAWS @ roots.transpose(0, 2, 1)
    clear = (np.hypot(places[..., 0], places[..., 1]) >= least_apart).sum(axis=1)
    # One more on both sides: what 64 draws do not show is not impossible.
    out: Array = (clear + 1.0) / (len(DRAWS) + 1.0)
    return out
