"""Trails: when a robot was where, as far as its nodes and their wakes tell."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.pose import Array
from mapweave.merge.mutual_exclusion.range_scans import RangeScans
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.solved_graph import PoseGraph

NANOSECONDS = 1e9
DRIFT = 0.02
"""How far a robot on its way is off beside its node, as a share of the way between them, one sigma."""


@dataclass(frozen=True, eq=False)
class BodyTrajectory:
    """N moments of a robot, by one clock: the images of its nodes, and their wakes.

    Attributes:
        clock: not empty.
        nodes: N, in the order of time: the node that tells of each moment.
        node_from_robot: (N, 3) m, m and rad: where the robot was beside it; zeros for the node's own image.
        times: (N,) s, ascending.
        radius: of the robot, m; 0 if not all nodes tell.
        looks: what its proximity sensors saw at each moment.
    """

    clock: str
    nodes: tuple[NodeId, ...]
    node_from_robot: Array
    times: Array
    radius: float
    looks: RangeScans

    @property
    def agent(self) -> str:
        """Whose it is."""
        return self.nodes[0].agent

    @property
    def drifts(self) -> Array:
        """(N,) m, how far the robot may have been elsewhere beside its node, standard deviation."""
        out: Array = DRIFT * np.hypot(self.node_from_robot[:, 0], self.node_from_robot[:, 1])
        return out

    def poses(self, graph: PoseGraph) -> Array:
        """(N, 3) m, m and rad: where the robot was at each moment, in the frame of a graph of all nodes."""
        at = graph.means[graph.index(self.nodes)]
        x, y, turn = self.node_from_robot.T
        cos, sin = np.cos(at[:, 2]), np.sin(at[:, 2])
        out: Array = np.stack(
            [at[:, 0] + cos * x - sin * y, at[:, 1] + sin * x + cos * y, at[:, 2] + turn], axis=1
        )
        return out


def trajectories_of(nodes: Collection[Node]) -> tuple[BodyTrajectory, ...]:
    """The trails of one robot's nodes, one a clock; nodes whose clock nobody knows are left out."""
    by_clock: dict[str, list[Node]] = {}
    for node in nodes:
        if node.clock:
            by_clock.setdefault(node.clock, []).append(node)
    trails = []
    for clock, known in sorted(by_clock.items()):
        known.sort(key=lambda node: (node.stamp_ns, node.id))
        radius = min(node.radius for node in known)
        # Wakes of neighbours may overlap by a rounded moment: the order of time is made here.
        teller = np.concatenate([np.arange(len(known)), np.repeat(range(len(known)), _lengths(known))])
        wakes = [node.wake for node in known if len(node.wake)]
        ages = np.concatenate([np.zeros(len(known)), *(wake.ages for wake in wakes)])
        offsets = np.concatenate([np.zeros((len(known), 3)), *(wake.node_from_robot for wake in wakes)])
        times = _seconds(known)[teller] + ages
        order = np.argsort(times, kind="stable")
        looks = RangeScans.of([node.ranges for node in known], [node.wake for node in known]).take(order)
        ids = tuple(known[k].id for k in teller[order])
        trails.append(BodyTrajectory(clock, ids, offsets[order], times[order], radius, looks))
    return tuple(trails)


class TrajectoryCache:
    """The trajectories of fragments, read once. Fragments are never changed, only replaced."""

    def __init__(self) -> None:
        """Start empty."""
        self._known: dict[NodeId, tuple[Fragment, tuple[BodyTrajectory, ...]]] = {}

    def trajectories(self, fragment: Fragment, one: HybridMap) -> tuple[BodyTrajectory, ...]:
        """See `trajectories_of`; `one` holds the fragment's nodes."""
        known = self._known.get(fragment.name)
        if known is None or known[0] is not fragment:
            found = trajectories_of([one.nodes[node] for node in fragment.nodes])
            known = self._known[fragment.name] = fragment, found
        return known[1]


def _seconds(nodes: Sequence[Node]) -> Array:
    return np.array([node.stamp_ns for node in nodes]) / NANOSECONDS


def _lengths(nodes: Sequence[Node]) -> list[int]:
    return [len(node.wake) for node in nodes]


@dataclass(frozen=True, eq=False)
class Stay:
    """Where a robot was at T moments.

    Attributes:
        known: (T,) whether anybody knows.
        places: (T, 2) m, in the frame of the trail's places.
        spreads: (T, 2, 2) m^2, covariances: the robot wanders between the moments of its trail.
        nearest: (T,) index of the moment of the trail that is nearest in time.
    """

    known: NDArray[np.bool_]
    places: Array
    spreads: Array
    nearest: NDArray[np.int64]


LONGEST_GAP = 5.2
"""Between moments that are further apart in time nobody knows where the robot was, s."""
LONGEST_WAY = 1.0
"""Between moments that are further apart in space nobody knows where the robot was, m."""
ALONG = 0.15
"""How far ahead or behind on the line between two moments a robot may be midway, as a share of the line,
standard deviation: it stops and goes. In the simulator it is within 1 cm of the straight line, but up to a
third of its length ahead or behind."""
ASIDE = 0.05
"""Standard deviation to the side of the line midway, as a share of the line."""
CLOCK_ERROR = 0.05
"""Standard deviation between two robots with the same clock, s."""


def stay(trail: BodyTrajectory, places: Array, times: Array) -> Stay:
    """Where a robot was, on the straight lines between its moments, which it drives at a pace of its own.

    Args:
        trail: of N moments.
        places: (N, 2) m, where it was then.
        times: (T,) s.
    """
    before = np.clip(np.searchsorted(trail.times, times, side="right") - 1, 0, max(len(places) - 2, 0))
    after = np.minimum(before + 1, len(places) - 1)
    gaps = np.maximum(trail.times[after] - trail.times[before], 1e-9)
    lines = places[after] - places[before]
    lengths = np.hypot(lines[:, 0], lines[:, 1])
    share = np.clip((times - trail.times[before]) / gaps, 0.0, 1.0)
    at_moment = (share == 0.0) | (share == 1.0)
    known = (times >= trail.times[0]) & (times <= trail.times[-1])
    known &= at_moment | ((gaps <= LONGEST_GAP) & (lengths <= LONGEST_WAY))
    nearest = np.where(share < 0.5, before, after)
    bow = 4.0 * share * (1.0 - share) * lengths
    ahead = lines / np.maximum(lengths, 1e-9)[:, None]
    along2 = (ALONG * bow) ** 2 + (CLOCK_ERROR * lengths / gaps) ** 2
    aside2 = (ASIDE * bow) ** 2
    outer = ahead[:, :, None] * ahead[:, None, :]
    spreads = (along2 - aside2)[:, None, None] * outer + (aside2 + trail.drifts[nearest] ** 2)[
        :, None, None
    ] * np.eye(2)
    return Stay(known, places[before] + share[:, None] * lines, spreads, nearest)
