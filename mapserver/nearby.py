"""Where the robots of a fleet are, by what they say when they ask who is around them."""

from __future__ import annotations

import math
import threading
from typing import NamedTuple

from mapweave.hybridmap.nearby import MAX_NEARBY, NearbyAnswer, NearbyRequest, NearbyRobot
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.pose_graph.merged_map import MergedMap

KEPT = 15.0
"""What a robot has said is kept for so long, s: robots that are far from all others ask every 5 s."""
MAP_SIGMA = 0.05
"""Standard deviation of a robot's map against another's in the merged map, m: of answers in simulated offices
half are off by less than 0.03 m, and a tenth by more than 0.05 m. Of each pair the pose graph knows it, but
that costs more than all the rest of the answer."""
STILL = 0.05
"""A robot that has moved no further than this between its last two questions stands, m."""
CELL = 16.0
"""Side of the cells by which robots are found, m. What is not in a cell beside a robot's needs more than the
5 s between two questions to come near, at 1 m/s each."""
MOST_ROBOTS = 4096
"""Robots that are remembered: without keys, names cost nothing."""


class _Sighting(NamedTuple):
    """Where a robot was.

    Attributes:
        at: when, s.
        frame: the smallest node of the component, in whose frame it is.
        pose: `merged_from_robot`.
        request: what it said.
    """

    at: float
    frame: NodeId
    pose: Pose2
    request: NearbyRequest

    @property
    def cell(self) -> tuple[NodeId, int, int]:
        """Where it is found."""
        return self.frame, math.floor(self.pose.x / CELL), math.floor(self.pose.y / CELL)


class Nearby:
    """The last two places of each robot. Thread-safe."""

    def __init__(self) -> None:
        """No robot has asked."""
        self._turn = threading.Lock()
        self._seen: dict[str, tuple[_Sighting, ...]] = {}
        self._cells: dict[tuple[NodeId, int, int], set[str]] = {}

    def ask(self, request: NearbyRequest, merged: MergedMap, now: float) -> NearbyAnswer:
        """Keep where a robot is, and say who is around it.

        Of robots that ask at the same time each gets where the others were before: in lock-step the answers
        do not depend on who comes first.

        Args:
            request: of the robot.
            merged: the newest merged map.
            now: of a clock that only grows, s.
        """
        placed = next((start for start in request.starts if merged.component_of(start[0]) is not None), None)
        if placed is None:
            return NearbyAnswer((), f"none of the nodes around {request.robot} is in the merged map yet")
        node, node_from_robot = placed
        component = merged.component_of(node)
        assert component is not None, "placed"
        here = _Sighting(now, merged.graphs[component].anchor, merged.pose(node) @ node_from_robot, request)
        with self._turn:
            others = self._others(here)
            kept = self._forget(request.robot)
            if len(self._seen) >= MOST_ROBOTS:
                self._forget(next(iter(self._seen)))
            self._seen[request.robot] = (*kept[-1:], here)
            self._cells.setdefault(here.cell, set()).add(request.robot)
        around = sorted(others, key=lambda other: (here.pose.distance(other.pose), other.request.robot))
        robots = tuple(_seen_from(here, other) for other in around[:MAX_NEARBY])
        return NearbyAnswer(robots, "" if robots else "no other robot of this part of the map is near")

    def standing(self, node: NodeId, radius: float, merged: MergedMap, now: float) -> list[str]:
        """Robots that stand where a robot of some radius, m, would touch them, if it were at a node.

        Args:
            node: of the newest merged map.
            radius: of the robot that wants to be there, m.
            merged: the newest merged map.
            now: of the same clock, s.
        """
        component = merged.component_of(node)
        if component is None:
            return []
        request = NearbyRequest("", ((node, Pose2()),), 0.0, 0.0, radius, 0.0, 0.0)
        here = _Sighting(now, merged.graphs[component].anchor, merged.pose(node), request)
        with self._turn:
            around = [one.request.robot for one in self._others(here) if _touch(here, one)]
            return sorted(name for name in around if _still(self._seen[name]))

    def _others(self, here: _Sighting) -> list[_Sighting]:
        """Where the robots of the cells around one were when they last asked before now."""
        frame, i, j = here.cell
        cells = ((frame, i + di, j + dj) for di in (-1, 0, 1) for dj in (-1, 0, 1))
        names = {name for cell in cells for name in self._cells.get(cell, ())} - {here.request.robot}
        before = [[one for one in self._seen[name] if one.at < here.at] for name in names]
        newest = [seen[-1] for seen in before if seen]
        return [one for one in newest if one.frame == frame and here.at - one.at <= KEPT]

    def _forget(self, robot: str) -> tuple[_Sighting, ...]:
        """Take a robot out; what was kept of it."""
        seen = self._seen.pop(robot, ())
        if seen:
            cell = seen[-1].cell
            self._cells[cell].discard(robot)
            if not self._cells[cell]:
                del self._cells[cell]
        return seen


def _touch(one: _Sighting, other: _Sighting) -> bool:
    """Whether two robots would touch each other."""
    return one.pose.distance(other.pose) < one.request.radius + other.request.radius


def _still(seen: tuple[_Sighting, ...]) -> bool:
    """Whether a robot has been seen twice at one place."""
    return len(seen) == 2 and seen[0].frame == seen[1].frame and seen[0].pose.distance(seen[1].pose) < STILL


def _seen_from(here: _Sighting, other: _Sighting) -> NearbyRobot:
    """Another robot, from where the asking one is; its own heading error turns what is far away aside."""
    asking, one = here.request, other.request
    aside = asking.heading_sigma * here.pose.distance(other.pose)
    sigma = math.hypot(asking.sigma, aside, one.sigma, MAP_SIGMA)
    pose = here.pose.inverse() @ other.pose
    return NearbyRobot(one.robot, pose, sigma, one.radius, one.height, one.speed, here.at - other.at)
