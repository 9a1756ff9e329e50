"""Places that ways should not pass: a robot did not get through, or another one stands there."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Obstacle
from mapweave.hybridmap.segments import distances
from mapweave.mapserver.roadmap import Roadmap

Hop = frozenset[NodeId]
SLACK = 0.01
"""A robot that stands at a disc may come so much nearer to its centre as it drives away, m."""


class Disc(NamedTuple):
    """A place in the merged map.

    Attributes:
        component: of the merged map.
        x: m, in its frame.
        y: m, likewise.
        reach: ways pass that come nearer than this, m.
        cost: of a way through it, m; infinite if there is none.
    """

    component: int
    x: float
    y: float
    reach: float
    cost: float = math.inf


class Discs:
    """What some discs mean for the ways through one roadmap.

    Attributes:
        barred: pairs of nodes between which there is no way.
        costs: what others cost in addition, m: half of the disc's cost where a way goes in, and half where it
            comes out, however many edges it has within.
    """

    def __init__(self, roads: Roadmap, discs: Iterable[Disc]) -> None:
        """Find the edges that pass them."""
        self._discs = tuple(discs)
        self.barred: set[Hop] = set()
        self.costs: dict[Hop, float] = {}
        for disc in self._discs:
            pairs, begin, end = roads.segments(disc.component)
            if not pairs:
                continue
            centre = np.array([[disc.x, disc.y]])
            passing = np.flatnonzero(distances(centre, begin, end)[0] < disc.reach)
            outside = [np.linalg.norm(ends[passing] - centre, axis=1) >= disc.reach for ends in (begin, end)]
            for k, crossed in zip(passing.tolist(), np.sum(outside, axis=0).tolist(), strict=True):
                hop = frozenset(pairs[k])
                if math.isinf(disc.cost):
                    self.barred.add(hop)
                else:
                    self.costs[hop] = self.costs.get(hop, 0.0) + disc.cost * crossed / 2.0

    def entry(self, component: int, robot: Pose2, node: Pose2) -> float:
        """What it costs in addition to drive straight to a node, m; infinite if there is no way.

        A robot may always drive away from a disc in which it is.

        Args:
            component: of the merged map.
            robot: where it is, in the merged frame.
            node: likewise.
        """
        begin, end = np.array([[robot.x, robot.y]]), np.array([[node.x, node.y]])
        return sum(
            disc.cost
            for disc in self._discs
            if disc.component == component
            and float(distances(np.array([[disc.x, disc.y]]), begin, end)[0, 0])
            < min(disc.reach, math.dist((disc.x, disc.y), (robot.x, robot.y)) - SLACK)
        )


def placed(obstacle: Obstacle, roads: Roadmap) -> Disc | None:
    """Where an obstacle is in the merged map; None if its node is not in it."""
    component = roads.merged.component_of(obstacle.node)
    if component is None:
        return None
    at = roads.poses[obstacle.node] @ Pose2(obstacle.x, obstacle.y)
    return Disc(component, at.x, at.y, obstacle.reach)
