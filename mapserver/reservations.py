"""One robot at a time where two cannot pass each other: who may drive which part of its way.

A robot asks for the way ahead of it, again every second. It gets as much of it as no other robot holds, and
holds that until it asks again, or falls silent: leases expire, so a robot that died releases its own. Two
parts of ways exclude each other if robots on them would touch, whichever edges they are: two robots that
mapped one corridor have an edge each for it, and on a wide floor both may drive.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.query import ReserveAnswer, ReserveRequest
from mapweave.mapserver.routes import Router

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
ASIDE = 12
"""Nodes that are tried as a place to step aside."""

Points = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Lease:
    """What one robot holds.

    Attributes:
        component: of the merged map.
        radius: of the robot, m.
        here: (2,) where it is.
        held: (N, 2) points of the part that it may drive, `here` among them, and of what it claims: the way
            aside, which others leave free from their next question on.
        way: (N, 2) points of its whole way.
        since: since when it has held anything without a pause, s.
        until: s.
        waits_for: the robot that holds what it wants next; empty if it waits for none.
    """

    component: int
    radius: float
    here: Points
    held: Points
    way: Points
    since: float
    until: float
    waits_for: str


class Reservations:
    """Leases by robot. Thread-safe."""

    def __init__(self) -> None:
        """No robot holds anything."""
        self._leases: dict[str, _Lease] = {}
        self._turn = threading.Lock()

    def ask(self, request: ReserveRequest, router: Router, now: float) -> ReserveAnswer:
        """Give a robot as much of its way as is free.

        Args:
            request: its way. One without nodes releases what it holds.
            router: of the newest merged map.
            now: of a clock that only grows, s.
        """
        with self._turn:
            self._leases = {robot: lease for robot, lease in self._leases.items() if now < lease.until}
            before = self._leases.pop(request.robot, None)
            merged = router.merged
            component = merged.component_of(request.start)
            if not request.route or component is None:
                return ReserveAnswer(len(request.route), "", None, "")
            poses = router.roads.poses
            if any(node not in poses for node in (request.start, *request.route)):
                return ReserveAnswer(len(request.route), "", None, "the way leads over nodes without a pose")
            robot = poses[request.start] @ request.start_from_robot
            here = np.array([robot.x, robot.y])
            stops = np.array([here, *([poses[node].x, poses[node].y] for node in request.route)])
            radius = max(router.roads.union.nodes[node].radius for node in request.route) or RADIUS
            others = {name: one for name, one in self._leases.items() if one.component == component}
            granted, held, holder = _free(stops, radius, others)
            since = before.since if before is not None else now
            way = np.vstack([_points(a, b) for a, b in pairwise(stops)])
            lease = _Lease(component, radius, here, held, way, since, now + LEASE, holder)
            self._leases[request.robot] = lease
            if not holder:
                return ReserveAnswer(granted, "", None, "")
            aside = None
            if self._yields(request.robot):
                aside, claimed = _place_aside(request, lease, self._leases[holder], router)
                self._leases[request.robot] = replace(lease, held=np.vstack([held, claimed]))
                if aside is not None and _free(claimed, radius, others)[0] < len(claimed) - 1:
                    aside = None  # the other one drives there yet
            return ReserveAnswer(granted, holder, aside, f"{holder} drives there")

    def _yields(self, robot: str) -> bool:
        """Whether robots wait for each other in a circle, of which this one came last."""
        circle, name = [robot], self._leases[robot].waits_for
        while name in self._leases and name not in circle:
            circle.append(name)
            name = self._leases[name].waits_for
        return name == robot and robot == max(circle, key=lambda one: (self._leases[one].since, one))


def _points(a: Points, b: Points) -> Points:
    """(N, 2) points from a to b, both included."""
    count = max(int(np.ceil(np.linalg.norm(b - a) / STEP)), 1) + 1
    return np.linspace(a, b, count)


def _free(stops: Points, radius: float, others: Mapping[str, _Lease]) -> tuple[int, Points, str]:
    """How many stops of a way may be driven to, the points up to there, and who holds the next part."""
    held, length = stops[:1], 0.0
    trees = {name: cKDTree(other.held) for name, other in others.items()}
    for number, (a, b) in enumerate(pairwise(stops)):
        length += float(np.linalg.norm(b - a))
        part = _points(a, b)
        for name, other in sorted(others.items()):
            width = radius + other.radius + MARGIN
            if _touches(part, stops[0], trees[name], other, width):
                return number, held, name
        if number and length > AHEAD:
            return number, held, ""
        held = np.vstack([held, part])
    return len(stops) - 1, held, ""


def _touches(part: Points, here: Points, tree: cKDTree, other: _Lease, width: float) -> bool:
    """Whether a robot on a part of its way would touch another; it may always drive away from it."""
    distances, nearest = tree.query(part)
    close = distances < width
    # Where the other stands: only to come nearer to it is forbidden.
    stands = np.linalg.norm(other.held[nearest] - other.here, axis=1) < STEP
    leaves = distances >= np.linalg.norm(here - other.here) - 1e-9
    return bool((close & ~(stands & leaves)).any())


def _place_aside(
    request: ReserveRequest, lease: _Lease, other: _Lease, router: Router
) -> tuple[NodeId | None, Points]:
    """The nearest node off another's way that is reached without passing it, and the points up to it."""
    poses, tree = router.roads.active_poses, cKDTree(other.way)
    members = [node for node in router.merged.components[lease.component] if node in poses]
    places = np.array([[poses[node].x, poses[node].y] for node in members])
    away = np.linalg.norm(places - lease.here, axis=1)
    clear = np.flatnonzero(tree.query(places)[0] > lease.radius + other.radius + MARGIN)
    standing = {"": replace(other, held=other.here[None])}
    for k in clear[np.argsort(away[clear], kind="stable")][:ASIDE]:
        legs = router.route(request.start, members[k], start_from_robot=request.start_from_robot).legs
        ids = [leg.node.id for leg in legs if leg.node.id in poses]
        stops = np.array([lease.here, *([poses[node].x, poses[node].y] for node in ids)])
        way = np.vstack([lease.here[None], *(_points(a, b) for a, b in pairwise(stops))])
        if legs and _free(way, lease.radius, standing)[0] == len(way) - 1:
            return NodeId(*members[k]), way
    return None, lease.here[None]
