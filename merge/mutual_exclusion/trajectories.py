"""Trajectories: when a robot was where, by its nodes and their trajectory segments."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array
from mapweave.merge.mutual_exclusion.range_scans import RangeScans
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.solved_graph import PoseGraph

NANOSECONDS = 1e9
DRIFT = 0.02
"""Error of a robot's pose relative to its node, as a share of the way between them, one sigma."""


@dataclass(frozen=True, eq=False)
class RobotTrajectory:
    """N moments of a robot, by one clock: the images of its nodes, and their trajectory segments.

    Attributes:
        clock: not empty.
        nodes: N, in the order of time: the node of each moment.
        node_from_robot: (N, 3) m, m and rad: the robot's pose in it; zeros for the node's own image.
        times: (N,) s, ascending.
        radius: of the robot, m; 0 if unknown.
        looks: its proximity readings at each moment.
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
        """(N,) m, standard deviation of the robot's position relative to its node."""
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


BACKWARDS = 1.0
"""By which a clock may be set back while a robot maps, s."""


def runs_backwards(nodes: Collection[Node]) -> bool:
    """Whether the clock of a robot's nodes does: they are numbered in the order in which they were made."""
    times = _seconds(sorted(nodes, key=lambda node: node.id))
    return bool(len(times) and (np.maximum.accumulate(times) - times).max() > BACKWARDS)


def trajectories_of(nodes: Collection[Node]) -> tuple[RobotTrajectory, ...]:
    """The trajectories of one robot's nodes, one a clock, without clocks unknown or running backwards."""
    by_clock: dict[str, list[Node]] = {}
    for node in nodes:
        if node.clock:
            by_clock.setdefault(node.clock, []).append(node)
    trajectories = []
    for clock, nodes_of_clock in sorted(by_clock.items()):
        if runs_backwards(nodes_of_clock):
            continue
        nodes_of_clock.sort(key=lambda node: (node.stamp_ns, node.id))
        radius = min(node.radius for node in nodes_of_clock)
        # Segments of neighbours may overlap by a rounded moment: they are ordered by time here.
        lengths = np.array([len(node.segment) for node in nodes_of_clock], np.int64)
        own = np.arange(len(nodes_of_clock))
        teller = np.concatenate([own, np.repeat(own, lengths)])
        segments = [nodes_of_clock[k].segment for k in np.flatnonzero(lengths)]
        ages = np.concatenate([np.zeros(len(nodes_of_clock)), *(segment.ages for segment in segments)])
        offsets = np.concatenate(
            [np.zeros((len(nodes_of_clock), 3)), *(segment.node_from_robot for segment in segments)]
        )
        times = _seconds(nodes_of_clock)[teller] + ages
        order = np.argsort(times, kind="stable")
        scans = RangeScans.of([node.ranges for node in nodes_of_clock], segments, teller).take(order)
        ids = tuple(nodes_of_clock[k].id for k in teller[order])
        trajectories.append(RobotTrajectory(clock, ids, offsets[order], times[order], radius, scans))
    return tuple(trajectories)


class TrajectoryCache:
    """The trajectories of fragments, read once. Fragments are never changed, only replaced."""

    def __init__(self) -> None:
        self._entries: dict[NodeId, tuple[Fragment, tuple[RobotTrajectory, ...]]] = {}

    def trajectories(self, fragment: Fragment, hybrid_map: HybridMap) -> tuple[RobotTrajectory, ...]:
        """See `trajectories_of`; `hybrid_map` holds the fragment's nodes."""
        entry = self._entries.get(fragment.name)
        if entry is None or entry[0] is not fragment:
            of_fragment = trajectories_of([hybrid_map.nodes[node] for node in fragment.nodes])
            entry = self._entries[fragment.name] = fragment, of_fragment
        return entry[1]


def _seconds(nodes: Sequence[Node]) -> Array:
    return np.array([node.stamp_ns for node in nodes]) / NANOSECONDS


@dataclass(frozen=True, eq=False)
class Stay:
    """Where a robot was at T moments.

    Attributes:
        known: (T,) whether the pose is known.
        places: (T, 2) m, in the frame of the trajectory's places.
        spreads: (T, 2, 2) m^2, covariances: the robot moves freely between the moments of its trajectory.
        nearest: (T,) index of the trajectory's moment that is nearest in time.
    """

    known: NDArray[np.bool_]
    places: Array
    spreads: Array
    nearest: NDArray[np.int64]


LONGEST_GAP = 5.2
"""Between moments further apart in time the robot's pose is unknown, s."""
LONGEST_WAY = 1.0
"""Between moments further apart in space the robot's pose is unknown, m."""
ALONG = 0.15
"""How far ahead or behind on the line between two moments a robot may be midway, as a share of the line,
standard deviation: it stops and goes. In the simulator it is within 1 cm of the straight line, but up to a
third of its length ahead or behind."""
ASIDE = 0.05
"""Standard deviation to the side of the line midway, as a share of the line."""
CLOCK_ERROR = 0.05
"""Standard deviation between two robots with the same clock, s."""


def stay(trajectory: RobotTrajectory, places: Array, times: Array) -> Stay:
    """Where a robot was, on the straight lines between its moments, which it drives at a pace of its own.

    Args:
        trajectory: of N moments.
        places: (N, 2) m, where it was then.
        times: (T,) s.
    """
    before = np.clip(np.searchsorted(trajectory.times, times, side="right") - 1, 0, max(len(places) - 2, 0))
    after = np.minimum(before + 1, len(places) - 1)
    gaps = np.maximum(trajectory.times[after] - trajectory.times[before], 1e-9)
    lines = places[after] - places[before]
    lengths = np.hypot(lines[:, 0], lines[:, 1])
    share = np.clip((times - trajectory.times[before]) / gaps, 0.0, 1.0)
    at_moment = (share == 0.0) | (share == 1.0)
    inside = (times >= trajectory.times[0]) & (times <= trajectory.times[-1])
    inside &= at_moment | ((gaps <= LONGEST_GAP) & (lengths <= LONGEST_WAY))
    nearest = np.where(share < 0.5, before, after)
    bow = 4.0 * share * (1.0 - share) * lengths
    ahead = lines / np.maximum(lengths, 1e-9)[:, None]
    along2 = (ALONG * bow) ** 2 + (CLOCK_ERROR * lengths / gaps) ** 2
    aside2 = (ASIDE * bow) ** 2
    every_way, longer = aside2 + trajectory.drifts[nearest] ** 2, along2 - aside2
    x, y = ahead.T
    spreads = np.empty((len(times), 2, 2))
    spreads[:, 0, 0], spreads[:, 1, 1] = longer * (x * x) + every_way, longer * (y * y) + every_way
    spreads[:, 0, 1] = spreads[:, 1, 0] = longer * (x * y)
    return Stay(inside, places[before] + share[:, None] * lines, spreads, nearest)
