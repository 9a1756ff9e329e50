"""One robot at a time where two cannot pass each other: who may drive which part of its way.

A robot asks for the way ahead of it, again every second. It gets as much of it as no other robot holds, and
holds that until it asks again, or falls silent: leases expire, so a robot that died releases its own. Two
parts of ways exclude each other if robots on them would touch, whichever edges they are: two robots that
mapped one corridor have an edge each for it, and on a wide floor both may drive. A robot without a way holds
nothing: others drive around it. Only where it stands at another's goal does that one stop before.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import ReserveAnswer, ReserveRequest, RouteAnswer
from mapweave.mapserver.nearby import StandingRobot
from mapweave.mapserver.routes import Router
from mapweave.mapserver.wire_limits import LONGEST_LEG
from mapweave.merge.pose_graph.merged_map import MergedMap

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

LEASE = 5.0
"""A robot that has not asked for so long holds nothing any more, s; it asks every second."""
AHEAD = 10.0
"""A robot holds no more than this much of its way, m."""
MARGIN = 0.1
"""Kept between two robots, m: they are localized to a few centimetres."""
RADIUS = 0.2
"""Of a robot whose footprint is not known, m."""
STEP = 0.05
"""Between two points of a way that are compared, m."""
LONGEST = 1e4
"""Of a way, m: its points take 3 MB. A robot may say that it is a thousand kilometres from its node."""
ASIDE, APART = 12, 0.3
"""Places that are tried to step aside to, and m between two: a place has a node for each heading."""

Points = NDArray[np.float64]
Standing = Callable[[Points, int, float, MergedMap, float], Sequence[StandingRobot]]
"""Finds the robots that stand on a way; see mapweave.mapserver.nearby.Nearby.standing."""


@dataclass(frozen=True, eq=False)
class _Lease:
    """What one robot holds.

    Attributes:
        request: what it asked last.
        component: of the merged map.
        radius: of the robot, m.
        here: (2,) where it is.
        held: (N, 2) points of the part that it may drive, `here` among them, and of what it claims: the way
            aside, which others leave free from their next question on.
        way: (N, 2) points of its whole way.
        until: s.
        waits_for: the robot that holds what it wants next; empty if it waits for none.
    """

    request: ReserveRequest
    component: int
    radius: float
    here: Points
    held: Points
    way: Points
    until: float
    waits_for: str


@dataclass(frozen=True, eq=False)
class _Aside:
    """Where a robot steps aside.

    Attributes:
        node: the place.
        way: (N, 2) points up to it.
        boxed_in: whether the others will stand between it and its goal.
    """

    node: NodeId
    way: Points
    boxed_in: bool


@dataclass(eq=False)
class _Passing:
    """A robot's way leads past one that stands there without a way.

    Attributes:
        robot: that drives.
        until: s.
        asked: whether the node where the other one is in no way was looked for.
        aside: that node.
    """

    robot: str
    until: float
    asked: bool = False
    aside: NodeId | None = None


class Reservations:
    """Leases by robot. Thread-safe."""

    def __init__(self, standing: Standing, said: Callable[[str], float] = lambda robot: 0.0) -> None:
        """No robot holds anything.

        Args:
            standing: robots on a way.
            said: radius that a robot has given as its own, m; 0 if it has given none.
        """
        self._standing, self._said = standing, said
        self._leases: dict[str, _Lease] = {}
        self._passings: dict[str, _Passing] = {}
        self._turn = threading.Lock()

    def ask(self, request: ReserveRequest, router: Router, now: float) -> ReserveAnswer:
        """Give a robot as much of its way as is free.

        Args:
            request: its way. One without nodes releases what it holds.
            router: of the newest merged map.
            now: of a clock that only grows, s.

        Raises:
            InvalidValue: no robot drives such a way.
        """
        with self._turn:
            self._leases = {robot: lease for robot, lease in self._leases.items() if now < lease.until}
            self._leases.pop(request.robot, None)
            merged = router.merged
            component = merged.component_of(request.start)
            if not request.route or component is None:
                return ReserveAnswer(len(request.route), "", None, "")
            poses = router.roads.poses
            if any(node not in poses for node in (request.start, *request.route)):
                return ReserveAnswer(len(request.route), "", None, "the way leads over nodes without a pose")
            if any(merged.component_of(node) != component for node in request.route):
                # Their poses are in another frame.
                words = "the way leads over nodes of another part of the map"
                return ReserveAnswer(len(request.route), "", None, words)
            robot = poses[request.start] @ request.start_from_robot
            here = np.array([robot.x, robot.y])
            stops = np.array([here, *([poses[node].x, poses[node].y] for node in request.route)])
            if _too_long(stops):
                raise InvalidValue("the way is longer than any that a robot drives")
            radius = self.radius(request.robot, router)
            others = {name: one for name, one in self._leases.items() if one.component == component}
            granted, held, holder = _free(stops, radius, others)
            taken = ""
            if granted == len(request.route):
                at_goal = self._standing(stops[-1:], component, radius, merged, now)
                others_there = (one.robot for one in at_goal if one.robot != request.robot)
                taken = next((name for name in others_there if name not in self._leases), "")
            if taken:
                granted, holder = granted - 1, taken
                held = np.vstack([here[None], *(_points(a, b) for a, b in pairwise(stops[:-1]))])
            reason = f"{holder} stands at {request.route[-1]}" if taken else f"{holder} drives there"
            way = np.vstack([_points(a, b) for a, b in pairwise(stops)])
            lease = _Lease(request, component, radius, here, held, way, now + LEASE, holder)
            self._leases[request.robot] = lease
            self._note_standing(lease, stops[: granted + 1], stops[-1], merged, now)
            if not holder:
                return ReserveAnswer(granted, "", None, "")
            aside = self._yields(request.robot, router)
            if aside is None:
                return ReserveAnswer(granted, holder, None, reason, occupied=bool(taken))
            # Others that hold some of its way aside get no more of it from their next question on.
            self._leases[request.robot] = replace(lease, held=aside.way)
            free = _free(aside.way, radius, others)[0] == len(aside.way) - 1
            return ReserveAnswer(0, holder, aside.node if free else None, reason)

    def radius(self, robot: str, router: Router) -> float:
        """Radius of a robot, m, by its own nodes and by what it has said: those of others are theirs.

        Args:
            robot: its name.
            router: of the newest merged map.
        """
        return max(router.roads.radii.get(robot, 0.0), self._said(robot)) or RADIUS

    def ways(self, now: float) -> dict[str, tuple[NodeId, ...]]:
        """The nodes ahead of each robot that drives, in order; `now` is of the same clock, s."""
        with self._turn:
            return {robot: one.request.route for robot, one in self._leases.items() if now < one.until}

    def _note_standing(
        self, lease: _Lease, stops: Points, goal: Points, merged: MergedMap, now: float
    ) -> None:
        """Take note of robots without a way on what is granted of another's way, but for its goal."""
        self._passings = {name: one for name, one in self._passings.items() if now < one.until}
        robot = lease.request.robot
        for one in self._standing(stops, lease.component, lease.radius + MARGIN, merged, now):
            at_goal = np.hypot(one.x - goal[0], one.y - goal[1]) < lease.radius + one.radius
            if one.robot == robot or one.robot in self._leases or at_goal:
                continue
            passing = self._passings.setdefault(one.robot, _Passing(robot, now))
            if passing.robot == robot:
                passing.until = now + LEASE

    def room_for(
        self, robot: str, start: NodeId, start_from_robot: Pose2, router: Router, now: float
    ) -> NodeId | None:
        """The node where a robot that stands in another one's way is in no way; None without need, or one.

        Args:
            robot: its name.
            start: node that the robot knows itself by.
            start_from_robot: where it is exactly.
            router: of the newest merged map.
            now: of the same clock, s.
        """
        with self._turn:
            passing = self._passings.get(robot)
            component = router.merged.component_of(start)
            if passing is None or now >= passing.until or robot in self._leases or component is None:
                return None
            other = self._leases.get(passing.robot)
            if not passing.asked and other is not None and other.component == component:
                passing.asked, pose = True, router.roads.poses[start] @ start_from_robot
                here = np.array([pose.x, pose.y])
                request = ReserveRequest(robot, start, start_from_robot, (start,))
                radius = self.radius(robot, router)
                lease = _Lease(request, component, radius, here, here[None], here[None], now, passing.robot)
                aside = _place_aside(lease, [other], router)
                passing.aside = None if aside is None else aside.node
            return passing.aside

    def parked(
        self, stops: Points, component: int, radius: float, merged: MergedMap, now: float, asker: str
    ) -> list[StandingRobot]:
        """Robots that stand on a way without one of their own; for the arguments see `Nearby.standing`.

        The asking robot is left out.
        """
        with self._turn:
            underway = {asker, *(name for name, lease in self._leases.items() if now < lease.until)}
        there = self._standing(stops, component, radius + MARGIN, merged, now)
        return [one for one in there if one.robot not in underway]

    def _yields(self, robot: str, router: Router) -> _Aside | None:
        """Where a robot steps aside; None if robots do not wait for each other in a circle, or another does.

        It is the one with the shortest way to a place where it is in no other's way: one that is past its
        last such place cannot yield, however late it came.
        """
        circle, name = [robot], self._leases[robot].waits_for
        while name in self._leases and name not in circle:
            circle.append(name)
            name = self._leases[name].waits_for
        best: tuple[tuple[bool, int], str, _Aside] | None = None
        if name == robot:
            for one in sorted(circle, reverse=True):
                lease = self._leases[one]
                others = [self._leases[other] for other in circle if other != one]
                beside = [
                    other
                    for third, other in self._leases.items()
                    if third not in circle and other.component == lease.component
                ]
                aside = _place_aside(lease, others, router, beside)
                if aside is not None and (best is None or (aside.boxed_in, len(aside.way)) < best[0]):
                    best = (aside.boxed_in, len(aside.way)), one, aside
        return best[2] if best is not None and best[1] == robot else None


def _points(a: Points, b: Points) -> Points:
    """(N, 2) points from a to b, both included."""
    count = max(int(np.ceil(np.linalg.norm(b - a) / STEP)), 1) + 1
    return np.linspace(a, b, count)


def _too_long(stops: Points) -> bool:
    """Whether no robot drives a way: its points would be too many to compare."""
    legs = np.linalg.norm(np.diff(stops, axis=0), axis=1)
    return bool(legs.max() > LONGEST_LEG or legs.sum() > LONGEST)


def _free(stops: Points, radius: float, others: Mapping[str, _Lease]) -> tuple[int, Points, str]:
    """How many stops of a way may be driven to, the points that are held, and who holds the next part."""
    from scipy.spatial import cKDTree

    parts, length = [stops[:1]], 0.0
    trees = {name: cKDTree(other.held) for name, other in others.items()}
    for number, (a, b) in enumerate(pairwise(stops)):
        length += float(np.linalg.norm(b - a))
        part = _points(a, b)
        for name, other in sorted(others.items()):
            width = radius + other.radius + MARGIN
            if _touches(part, stops[0], trees[name], other, width):
                return number, np.vstack(parts), name
        if number and length > AHEAD:
            break
        # A first leg may be of any length: of that it holds no more either.
        parts.append(part[: math.ceil(AHEAD / STEP) + 1])
    else:
        number = len(stops) - 1
    return number, np.vstack(parts), ""


def _touches(part: Points, here: Points, tree: cKDTree, other: _Lease, width: float) -> bool:
    """Whether a robot on a part of its way would touch another; it may always drive away from it."""
    distances, nearest = tree.query(part, distance_upper_bound=width)
    close = distances < width
    if not close.any():
        return False
    # Where the other stands: only to come nearer to it is forbidden.
    stands = np.linalg.norm(other.held[nearest[close]] - other.here, axis=1) < STEP
    leaves = distances[close] >= np.linalg.norm(here - other.here) - 1e-9
    return not bool((stands & leaves).all())


def _place_aside(
    lease: _Lease, others: Sequence[_Lease], router: Router, beside: Sequence[_Lease] = ()
) -> _Aside | None:
    """The nearest node off the others' ways that is reached without passing them.

    One from which the goal is reached when they are at theirs comes first: behind them it would be boxed in.

    Args:
        lease: of the robot that steps aside.
        others: of robots that it lets pass.
        router: of the newest merged map.
        beside: of robots that it does not wait for, and that do not wait for it: they stand where they are.
    """
    from scipy.spatial import cKDTree

    request, poses = lease.request, router.roads.active_poses
    component = router.merged.component_of(request.start)  # the map may be newer than the lease
    members = [n for n in router.merged.components[component] if n in poses] if component is not None else []
    if not members:
        return None
    places = np.array([[poses[node].x, poses[node].y] for node in members])
    away = np.linalg.norm(places - lease.here, axis=1)
    off = [cKDTree(one.way).query(places)[0] > lease.radius + one.radius + MARGIN for one in others]
    clear = np.flatnonzero(np.all(off, axis=0))
    now = {str(k): replace(one, held=one.here[None]) for k, one in enumerate([*others, *beside])}
    then = {str(k): replace(one, here=one.way[-1], held=one.way[-1:]) for k, one in enumerate(others)}
    boxed_in: _Aside | None = None
    tried: list[int] = []
    for k in clear[np.argsort(away[clear], kind="stable")]:
        if len(tried) == ASIDE:
            break
        if tried and np.linalg.norm(places[tried] - places[k], axis=1).min() < APART:
            continue
        tried.append(int(k))
        node = NodeId(*members[k])
        way = _way(lease.here, router.route(request.start, node, (), (), request.start_from_robot), poses)
        if way is None or _free(way, lease.radius, now)[0] < len(way) - 1:
            continue
        onward = _way(places[k], router.route(node, request.route[-1]), poses)
        if onward is not None and _free(onward, lease.radius, then)[0] == len(onward) - 1:
            return _Aside(node, way, False)
        boxed_in = boxed_in or _Aside(node, way, True)
    return boxed_in


def _way(here: Points, answer: RouteAnswer, poses: Mapping[NodeId, Pose2]) -> Points | None:
    """(N, 2) points from a place along a route; None without one, and of one that no robot drives."""
    nodes = [leg.node.id for leg in answer.legs if leg.node.id in poses]
    stops = np.array([here, *([poses[node].x, poses[node].y] for node in nodes)])
    if not nodes or _too_long(stops):
        return None
    return np.vstack([here[None], *(_points(a, b) for a, b in pairwise(stops))])
