"""Trails: when a robot was where, as far as its nodes tell."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.node import Node, NodeId
from hybridmap.pose import Array
from merge.bodies.looks import Looks

NANOSECONDS = 1e9


@dataclass(frozen=True)
class TrailSettings:
    """How well it is known where a robot is between two nodes.

    In the simulator it is within 1 cm of the straight line, but up to a third of its length ahead or behind.

    Attributes:
        longest_gap: between nodes that are further apart in time nobody knows where the robot was, s.
        longest_way: nor if they are further apart, m.
        along: how far ahead or behind on the line between two nodes a robot may be midway, as a share of the
            line, standard deviation: it stops and goes.
        aside: the same to the side of the line.
        clock_error: of two robots with the same clock, s.
    """

    longest_gap: float = 5.2
    longest_way: float = 1.0
    along: float = 0.15
    aside: float = 0.05
    clock_error: float = 0.05


@dataclass(frozen=True, eq=False)
class Trail:
    """When a robot was at which node, by one clock.

    Attributes:
        clock: not empty.
        nodes: N, in the order of their stamps.
        times: (N,) s, ascending.
        radius: of the robot, m; 0 if not all nodes tell.
        looks: what its proximity sensors saw at each node.
        views: what its camera saw there: the N nodes themselves.
    """

    clock: str
    nodes: tuple[NodeId, ...]
    times: Array
    radius: float
    looks: Looks
    views: tuple[Node, ...]

    @property
    def agent(self) -> str:
        """Whose it is."""
        return self.nodes[0].agent


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
        looks = Looks.of([node.ranges for node in known])
        ids = tuple(node.id for node in known)
        trails.append(Trail(clock, ids, times, radius, looks, tuple(known)))
    return tuple(trails)


@dataclass(frozen=True, eq=False)
class Stay:
    """Where a robot was at T moments.

    Attributes:
        known: (T,) whether anybody knows.
        places: (T, 2) m, in the frame of the nodes' places.
        spreads: (T, 2, 2) m^2, covariances: the robot wanders between its nodes.
        nearest: (T,) index of the node of the trail that is nearest in time.
    """

    known: NDArray[np.bool_]
    places: Array
    spreads: Array
    nearest: NDArray[np.int64]


def stay(trail: Trail, places: Array, times: Array, settings: TrailSettings | None = None) -> Stay:
    """Where a robot was, on the straight lines between its nodes, which it drives at a pace of its own.

    Args:
        trail: of N nodes.
        places: (N, 2) m, where they are.
        times: (T,) s.
        settings: how well that is known.
    """
    s = settings or TrailSettings()
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
    return Stay(known, places[before] + share[:, None] * lines, spreads, np.where(share < 0.5, before, after))
