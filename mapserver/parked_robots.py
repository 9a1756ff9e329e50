"""Routes past robots that stand on the way: by another way where that is not much longer."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.query import RouteAnswer, RouteRequest
from mapweave.mapserver.nearby import StandingRobot
from mapweave.mapserver.obstacles import Disc
from mapweave.mapserver.reservations import MARGIN, RADIUS
from mapweave.mapserver.roadmap import Roadmap

PARKED_COST = 10.0
"""Cost of a way past a robot that stands there, m: to drive up to it, to try for 8 s, and to drive back."""
MOST_PARKED = 8
"""Ways that are tried until one leads past no further robot: each costs a search."""

Standing = Callable[[Array, int, float], Sequence[StandingRobot]]
"""Finds the robots that stand on a way, (N, 2) m in a component's frame, of a robot of some radius, m."""


def route_past_parked(
    request: RouteRequest,
    roads: Roadmap,
    route: Callable[[Sequence[Disc]], RouteAnswer],
    standing: Standing,
    radius: float | None = None,
) -> RouteAnswer:
    """The best way, by the robots that stand on the ways to the goal.

    Args:
        request: where from, where to.
        roads: of the newest merged map.
        route: finds the best way, by places that cost more.
        standing: finds robots on a way.
        radius: of the robot that asks, m; None if it has no name: then it is as large as those that have
            mapped its way.
    """
    component = roads.merged.component_of(request.start)
    answer = shortest = route(())
    if component is None:
        return answer
    known: dict[str, StandingRobot] = {}
    first: list[str] = []
    for _ in range(MOST_PARKED):
        stops, widest = _way(request, answer, roads)
        size = widest if radius is None else radius
        there = standing(stops, component, size) if answer.legs else ()
        new = {one.robot: one for one in there if one.robot not in known}
        first = first if known else [*new]
        if not new:
            break
        known |= new
        answer = route([
            Disc(component, one.x, one.y, size + one.radius + MARGIN, PARKED_COST) for one in known.values()
        ])  # fmt: skip
    avoided = [name for name in first if name not in {one.robot for one in there}]
    if answer is shortest or not avoided:
        return answer
    stands = "stand" if len(avoided) > 1 else "stands"
    return replace(answer, detour=f"{', '.join(avoided)} {stands} on a shorter way")


def _way(request: RouteRequest, answer: RouteAnswer, roads: Roadmap) -> tuple[Array, float]:
    """(N, 2) m, the stops of a way from where the robot is, and the largest radius of its nodes, m."""
    nodes = [leg.node for leg in answer.legs]
    poses = [roads.poses[request.start] @ request.start_from_robot]
    poses += [roads.poses[node.id] for node in nodes if node.id in roads.poses]
    radius = max((node.radius for node in nodes), default=0.0) or RADIUS
    return np.array([(pose.x, pose.y) for pose in poses]), radius
