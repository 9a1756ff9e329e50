"""Ways past places and robots: which edges pass them, what that costs, and who is avoided."""

import math
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.nearby import NearbyRequest
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Obstacle, ReserveRequest, RouteAnswer, RouteRequest
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.nearby import Nearby
from mapweave.mapserver.obstacles import Disc, Discs, placed
from mapweave.mapserver.parked_robots import route_past_parked
from mapweave.mapserver.reservations import Reservations
from mapweave.mapserver.routes import Router
from tests.mapserver.driven_maps import driven_map, place_node, take_in
from tests.mapserver.test_reservations import CORRIDOR, HALL, MAP, NICHE, node, router  # noqa: F401 - a fixture

PLACES = [*CORRIDOR, NICHE, *HALL]
RADIUS = 0.16


def passes(a: NodeId, b: NodeId, x: float, y: float, reach: float) -> bool:
    """By points all along the edge."""
    ends = [np.array(PLACES[end.number - 1]) for end in (a, b)]
    along = ends[0] + np.linspace(0.0, 1.0, 2001)[:, None] * (ends[1] - ends[0])
    return bool(np.linalg.norm(along - [x, y], axis=1).min() < reach)


def stops(answer: RouteAnswer) -> list[int]:
    return [leg.node.id.number - 1 for leg in answer.legs]


@pytest.mark.parametrize("seed", range(6))
def test_edges_that_pass_a_place_are_those_that_points_along_them_show(router: Router, seed: int):  # noqa: F811
    rng = np.random.default_rng(seed)
    (x, y), reach = rng.uniform([-1.0, -1.0], [9.0, 6.0]), rng.uniform(0.05, 1.5)
    edges = router.roads.union.edges.values()
    expected = {frozenset((e.a, e.b)) for e in edges if passes(e.a, e.b, x, y, reach)}
    assert Discs(router.roads, [Disc(0, x, y, reach)]).barred == expected
    assert (
        Discs(router.roads, [Disc(1 if router.merged.components[1:] else 0, 99.0, 99.0, reach)]).barred
        == set()
    )


def test_an_obstacle_is_placed_by_its_node(router: Router):  # noqa: F811
    assert placed(Obstacle(NodeId("z", 1, 1), 0.0, 0.0, 1.0), router.roads) is None
    disc = placed(Obstacle(node(3), 0.5, 0.25, 0.3), router.roads)
    assert disc is not None
    here = router.roads.poses[node(3)] @ Pose2(0.5, 0.25)
    assert (disc.x, disc.y, disc.reach) == pytest.approx((here.x, here.y, 0.3)) and math.isinf(disc.cost)


def test_a_barred_place_closes_every_edge_through_it_and_the_way_in(router: Router):  # noqa: F811
    """A robot before an obstacle at (3.4, 0): nodes beyond are within reach of a straight entry."""
    blocked = Disc(0, 3.4, 0.0, 0.3)
    start, here = node(3), Pose2(0.05, 0.0)
    assert stops(router.route(start, node(5), start_from_robot=here))[-1] == 5
    answer = router.past([blocked]).route(start, node(5), start_from_robot=here)
    assert answer.legs == () or 10 in stops(answer), "there is the way by the hall alone, from the other end"
    assert answer.legs == (), "which nothing joins on this side"
    assert "block" in answer.reason
    inside = router.past([Disc(0, 3.1, 0.0, 0.3)]).route(start, node(0), start_from_robot=here)
    assert stops(inside)[-1] == 0, "it may always drive away"
    assert router.past([Disc(0, 3.4, 2.5, 0.3)]).route(start, node(5)).legs, "what is elsewhere is in no way"


def test_a_way_through_a_dear_place_pays_once_however_many_edges_it_has_there(router: Router):  # noqa: F811
    for reach in (0.3, 0.7, 1.2, 2.6):
        costs = Discs(router.roads, [Disc(0, 4.5, 0.0, reach, 8.0)]).costs
        way = [frozenset(pair) for pair in pairwise(map(node, range(9)))]
        assert sum(costs.get(hop, 0.0) for hop in way) == pytest.approx(8.0)
        half = [frozenset(pair) for pair in pairwise(map(node, range(5)))]
        inside = math.dist(PLACES[4], (4.5, 0.0)) < reach
        assert sum(costs.get(hop, 0.0) for hop in half) == pytest.approx(4.0 if inside else 0.0)


class Fleet:
    """Robots that stand, and one that asks for its way."""

    def __init__(self, router: Router) -> None:  # noqa: F811
        self.router, self.nearby, self.now = router, Nearby(), 0.0
        self.reservations = Reservations(self.nearby.standing)
        self.searches = 0

    def stand(self, robot: str, number: int, aside: float = 0.0, seconds: float = 10.0) -> None:
        for now in (self.now, self.now + seconds):
            place = ((node(number), Pose2(0.0, aside)),)
            self.nearby.ask(
                NearbyRequest(robot, place, 0.01, 0.01, RADIUS, 0.3, 0.3), self.router.merged, now
            )
        self.now += seconds + 0.1

    def way(self, start: int, goal: int) -> RouteAnswer:
        request = RouteRequest(node(start), node(goal))

        def route(discs) -> RouteAnswer:
            self.searches += 1
            return self.router.past(discs).route(request.start, request.goal)

        def standing(way, component, radius):
            return self.reservations.parked(way, component, radius, self.router.merged, self.now, "r0")

        return route_past_parked(request, self.router.roads, route, standing)


@pytest.fixture
def ring() -> Router:
    """Two ways from node 0 to node 4: 4 m by the corridor, 8 m by the hall."""
    places = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (4.0, 0.0), (4.0, 2.0), (2.0, 2.0), (0.0, 2.0)]
    nodes = [place_node(node(k), place) for k, place in enumerate(places)]
    merger = Merger()
    take_in(merger, MAP, driven_map(MAP, nodes, [(k, (k + 1) % 8) for k in range(8)]))
    return Router(merger.merged())


def test_another_way_is_taken_at_once_and_the_reason_said(ring: Router):
    fleet = Fleet(ring)
    assert stops(fleet.way(0, 4)) == [0, 1, 2, 3, 4] and fleet.searches == 1, "without robots one search"
    fleet.stand("r1", 2)
    answer = fleet.way(0, 4)
    assert stops(answer) == [0, 7, 6, 5, 4] and answer.detour == "r1 stands on a shorter way"
    fleet.stand("r2", 6)
    both = fleet.way(0, 4)
    assert stops(both) == [0, 1, 2, 3, 4] and both.detour == "", "past one of them, then by the shorter way"


def test_who_stands_beside_the_way_drives_or_has_asked_only_once_is_in_no_way(ring: Router):
    fleet = Fleet(ring)
    fleet.stand("r1", 2, aside=0.6)
    fleet.stand("r2", 2, seconds=1.0)
    assert stops(fleet.way(0, 4)) == [0, 1, 2, 3, 4] and fleet.searches == 1
    fleet.stand("r2", 2)
    fleet.reservations.ask(ReserveRequest("r2", node(2), Pose2(), (node(3),)), ring, fleet.now)
    assert stops(fleet.way(0, 4)) == [0, 1, 2, 3, 4], "a robot on its way leaves"


def test_where_there_is_no_other_way_it_leads_past_the_robot(router: Router):  # noqa: F811
    """The corridor's ends are joined by nothing else: the way leads past the robot."""
    fleet = Fleet(router)
    fleet.stand("r1", 4)
    answer = fleet.way(0, 8)
    assert stops(answer) == list(range(9)) and answer.detour == ""
