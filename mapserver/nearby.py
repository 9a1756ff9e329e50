"""Where the robots of a fleet are, by what they say when they ask who is around them."""

import math
import threading
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.nearby import MAX_NEARBY, NearbyAnswer, NearbyRequest, NearbyRobot
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.hybridmap.segments import distances
from mapweave.merge.pose_graph.merged_map import MergedMap

KEPT = 15.0
"""What a robot has said is kept for so long, s: robots that are far from all others ask every 5 s."""
MAP_SIGMA = 0.05
"""Standard deviation of a robot's map against another's in the merged map, m: of answers in simulated offices
half are off by less than 0.03 m, and a tenth by more than 0.05 m. Of each pair the pose graph knows it, but
that costs more than all the rest of the answer."""
STILL = 0.05
"""A robot that has moved no further than this from where it stopped stands, m."""
STOOD = 3.0
"""A robot that has stood for so long stands: one that drives also turns on the spot, and looks, s."""
CELL = 16.0
"""Side of the cells by which robots are found, m. What is not in a cell beside a robot's needs more than the
5 s between two questions to come near, at 1 m/s each."""
MOST_ROBOTS = 4096
"""Robots that are remembered: without keys, names cost nothing."""


_Cell = tuple[NodeId, int, int]


class _Sighting(NamedTuple):
    """Where a robot was.

    Attributes:
        at: when, s.
        frame: the smallest node of the component, in whose frame it is.
        pose: `merged_from_robot`.
        request: what it said.
        stopped: since when, s, and where it has stood.
    """

    at: float
    frame: NodeId
    pose: Pose2
    request: NearbyRequest
    stopped: tuple[float, Pose2]

    @property
    def cell(self) -> _Cell:
        """Where it is found."""
        return _cell(self.frame, self.pose.x, self.pose.y)


class StandingRobot(NamedTuple):
    """A robot that stands somewhere.

    Attributes:
        robot: its name.
        x: m, in the merged frame of its component.
        y: m, likewise.
        radius: of its footprint, m.
    """

    robot: str
    x: float
    y: float
    radius: float


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
        frame, pose = merged.graphs[component].anchor, merged.pose(node) @ node_from_robot
        with self._turn:
            others = self._around({_cell(frame, pose.x, pose.y)}, now, request.robot)
            kept = self._forget(request.robot)
            here = _Sighting(now, frame, pose, request, _stopped(kept, frame, pose, now))
            if len(self._seen) >= MOST_ROBOTS:
                self._forget(next(iter(self._seen)))
            self._seen[request.robot] = (*kept[-1:], here)
            self._cells.setdefault(here.cell, set()).add(request.robot)
        around = sorted(others, key=lambda other: (pose.distance(other.pose), other.request.robot))
        robots = tuple(_seen_from(here, other) for other in around[:MAX_NEARBY])
        return NearbyAnswer(robots, "" if robots else "no other robot of this part of the map is near")

    def radius(self, robot: str) -> float:
        """Radius that a robot has said last that it has, m; 0 if it has said nothing."""
        with self._turn:
            seen = self._seen.get(robot, ())
        return seen[-1].request.radius if seen else 0.0

    def standing(
        self, stops: Array, component: int, radius: float, merged: MergedMap, now: float
    ) -> list[StandingRobot]:
        """Robots that stand where another one would touch them on its way.

        Args:
            stops: (N, 2) m, the way from stop to stop in the merged frame; one alone is a place.
            component: of the newest merged map.
            radius: of the robot that drives there, m.
            merged: the newest merged map.
            now: of the same clock, s.
        """
        frame = merged.graphs[component].anchor
        with self._turn:
            around = self._around({_cell(frame, x, y) for x, y in stops.tolist()}, now)
        still = sorted(
            StandingRobot(one.request.robot, one.pose.x, one.pose.y, one.request.radius)
            for one in around
            if now - one.stopped[0] >= STOOD
        )
        places = np.array([(one.x, one.y) for one in still]).reshape(-1, 2)
        off = distances(places, np.vstack([stops[:1], stops[:-1]]), stops).min(axis=1)
        return [one for one, d in zip(still, off.tolist(), strict=True) if d < radius + one.radius]

    def left(self, robot: str, place: tuple[float, float], reach: float, frame: NodeId, now: float) -> bool:
        """Whether a robot is known to be elsewhere than within some reach, m, of a place, m, in a frame."""
        with self._turn:
            seen = [one for one in self._seen.get(robot, ()) if one.at < now and now - one.at <= KEPT]
        return bool(seen) and (
            seen[-1].frame != frame or math.dist(place, (seen[-1].pose.x, seen[-1].pose.y)) > reach
        )

    def _around(self, cells: Collection[_Cell], now: float, but: str = "") -> list[_Sighting]:
        """Where the robots in some cells, and in those around them, were when they last asked before now."""
        beside = [(di, dj) for di in (-1, 0, 1) for dj in (-1, 0, 1)]
        around = {(frame, i + di, j + dj) for frame, i, j in cells for di, dj in beside}
        names = {name for cell in around for name in self._cells.get(cell, ())} - {but}
        before = [[one for one in self._seen[name] if one.at < now] for name in names]
        frames = {frame for frame, _, _ in cells}
        newest = [seen[-1] for seen in before if seen]
        return [one for one in newest if one.frame in frames and now - one.at <= KEPT]

    def _forget(self, robot: str) -> tuple[_Sighting, ...]:
        """Take a robot out; what was kept of it."""
        seen = self._seen.pop(robot, ())
        if seen:
            cell = seen[-1].cell
            self._cells[cell].discard(robot)
            if not self._cells[cell]:
                del self._cells[cell]
        return seen


def _cell(frame: NodeId, x: float, y: float) -> _Cell:
    return frame, math.floor(x / CELL), math.floor(y / CELL)


def _stopped(before: tuple[_Sighting, ...], frame: NodeId, pose: Pose2, now: float) -> tuple[float, Pose2]:
    """Since when a robot has stood, and where: where it was, if it has not moved from there."""
    for last in before[-1:]:
        if last.frame == frame and last.stopped[1].distance(pose) < STILL:
            return last.stopped
    return now, pose


def _seen_from(here: _Sighting, other: _Sighting) -> NearbyRobot:
    """Another robot, from where the asking one is; its own heading error turns what is far away aside."""
    asking, one = here.request, other.request
    aside = asking.heading_sigma * here.pose.distance(other.pose)
    sigma = math.hypot(asking.sigma, aside, one.sigma, MAP_SIGMA)
    pose = here.pose.inverse() @ other.pose
    return NearbyRobot(one.robot, pose, sigma, one.radius, one.height, one.speed, here.at - other.at)
