"""One robot at a time where two cannot pass: leases by the ground that robots cover."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.constraint_subject import Linked
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.nearby import NearbyRequest
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import ReserveAnswer, ReserveRequest
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.nearby import Nearby
from mapweave.mapserver.reservations import AHEAD, LEASE, Reservations
from mapweave.mapserver.routes import Router
from tests.mapserver.driven_maps import driven_map, place_node, take_in

MAP = MapId("a", 1)
CORRIDOR = [(float(x), 0.0) for x in range(9)]
NICHE = (4.0, 1.5)
HALL = [(float(x), 5.0) for x in range(9)]
"""Beside the corridor, with its own nodes; joined at the end."""


@pytest.fixture(scope="module")
def router() -> Router:
    """A corridor of nine nodes 1 m apart with a niche beside the fifth, and a hall beside it."""
    places = [*CORRIDOR, NICHE, *HALL]
    joints = [*((k, k + 1) for k in range(8)), (4, 9), *((k, k + 1) for k in range(10, 18)), (8, 18)]
    merger = Merger()
    nodes = [place_node(NodeId(*MAP, k + 1), place) for k, place in enumerate(places)]
    take_in(merger, MAP, driven_map(MAP, nodes, joints))
    return Router(merger.merged())


def node(number: int) -> NodeId:
    return NodeId(*MAP, number + 1)


class Traffic:
    """Robots that ask for the way from node to node."""

    def __init__(self, router: Router) -> None:
        self.router, self.nearby, self.now = router, Nearby(), 0.0
        self.reservations = Reservations(self.nearby.standing)

    def ask(self, robot: str, *way: int, off: float = 0.0) -> ReserveAnswer:
        route = tuple(map(node, way[1:] if len(way) > 1 else way))
        request = ReserveRequest(robot, node(way[0]), Pose2(off, 0.0, 0.0), route)
        return self.reservations.ask(request, self.router, self.now)


def test_the_way_of_a_lone_robot_is_free_as_far_as_it_may_hold_it(router: Router):
    traffic = Traffic(router)
    assert traffic.ask("r0", 0, 1, 2, 3, 4) == ReserveAnswer(4, "", None, "")
    assert AHEAD == 10.0
    long = traffic.ask("r0", 0, *range(1, 9), 18, 17, 16, 15, 14)
    assert 8 <= long.granted < 13 and long.holder == "", "it holds no more than the next 10 m"


def test_the_ways_of_robots_are_known_while_they_drive(router: Router):
    traffic = Traffic(router)
    traffic.ask("r0", 0, 1, 2, 3, 4)
    traffic.ask("r1", 12, 13, 14)
    way = tuple(map(node, (1, 2, 3, 4)))
    assert traffic.reservations.ways(0.0) == {"r0": way, "r1": tuple(map(node, (13, 14)))}
    assert traffic.reservations.ways(LEASE) == {}
    here = ReserveRequest("r1", node(13), Pose2(), ())
    assert traffic.reservations.ask(here, router, 1.0).granted == 0
    assert traffic.reservations.ways(1.0) == {"r0": way}


def test_a_way_that_no_robot_drives_takes_no_time_and_holds_nothing(router: Router):
    """A robot may say that it is a thousand kilometres away, or that it drives to and fro without end."""
    traffic = Traffic(router)
    for ask in (
        lambda: traffic.ask("r0", 0, 1, 2, off=1e6),
        lambda: traffic.ask("r0", 0, 1, 2, off=2e3),
        lambda: traffic.ask("r0", 0, *(k for _ in range(1000) for k in (1, 8))),
    ):
        with pytest.raises(InvalidValue, match="longer than any that a robot drives"):
            ask()
    assert traffic.ask("r1", 0, 1, 2, 3).granted == 3
    # Nor when it stands in another's way.
    traffic = Traffic(router)
    for traffic.now in (0.0, 1.0, 5.0):
        here = NearbyRequest("r0", ((node(2), Pose2()),), 0.05, 0.02, 0.2, 0.4, 0.5)
        traffic.nearby.ask(here, router.merged, traffic.now)
    traffic.now = 5.1
    traffic.ask("r1", 0, 1, 2, 3)
    assert traffic.reservations.room_for("r0", node(2), Pose2(1e6, 0.0, 0.0), router, traffic.now) is None


def test_no_robot_holds_a_leg_of_any_length(router: Router):
    """Of a first leg of 900 m, straight through the corridor, it held all: no other robot drove any more."""
    for begin in (-900.0, 20.0):
        traffic = Traffic(router)
        far = ReserveRequest("r9", node(0), Pose2(begin, 0.0, 0.0), (node(8 if begin < 0.0 else 0),))
        for traffic.now in (0.0, 1.0):
            traffic.reservations.ask(far, router, traffic.now)
            for robot in range(0, 8, 2):
                assert traffic.ask(f"r{robot}", robot, robot + 1).granted == 1


OWN, OTHERS = ("r0", 0, 0.3), ("r9", 2, 5.0)
"""Robots, each with two nodes 1 m apart from so far along the corridor on, and its radius, m."""


def two_robots(joined: bool) -> Router:
    merger = Merger()
    for robot, first, radius in (OWN, OTHERS):
        places = [(float(first + k), 0.0) for k in (0, 1)]
        nodes = [replace(place_node(NodeId(robot, 1, k), at), radius=radius) for k, at in enumerate(places)]
        take_in(merger, MapId(robot, 1), driven_map(MapId(robot, 1), nodes, [(0, 1)], EdgeKind.MAPPED))
    if joined:
        link = Linked(NodeId("r0", 1, 1), NodeId("r9", 1, 0), Pose2(1.0), (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4))
        merger.constrain(ManualConstraints((ManualConstraint(link, True, "anna", 1),)))
    return Router(merger.merged())


def test_a_robot_is_as_large_as_it_says_itself_and_as_no_other_says():
    """A node on its way is of a robot of 5 m: it was taken for as large, and waited for one 3 m ahead."""
    router, nearby = two_robots(joined=True), Nearby()
    here, near, far = NodeId("r0", 1, 0), NodeId("r9", 1, 0), NodeId("r9", 1, 1)
    assert router.merged.component_of(here) == router.merged.component_of(far)
    reservations = Reservations(nearby.standing, nearby.radius)
    assert [reservations.radius(robot, router) for robot in ("r0", "r9", "r1")] == [0.3, 5.0, 0.2]
    nearby.ask(NearbyRequest("r1", ((near, Pose2()),), 0.05, 0.02, 0.4, 0.4, 0.5), router.merged, 0.0)
    assert reservations.radius("r1", router) == 0.4, "it has mapped nothing"
    ahead = ReserveRequest("r1", far, Pose2(2.0), (far,))
    assert reservations.ask(ahead, router, 0.0).granted == 1
    way = ReserveRequest("r0", here, Pose2(), (NodeId("r0", 1, 1), near))
    assert reservations.ask(way, router, 0.0).granted == 2


def test_nothing_is_held_on_a_way_through_another_part_of_the_map():
    """Poses of nodes that are not joined are in different frames."""
    router = two_robots(joined=False)
    reservations = Reservations(Nearby().standing)
    here, there = NodeId("r0", 1, 0), NodeId("r9", 1, 1)
    answer = reservations.ask(ReserveRequest("r0", here, Pose2(), (there,)), router, 0.0)
    assert answer == ReserveAnswer(1, "", None, "the way leads over nodes of another part of the map")
    assert reservations.ways(0.0) == {}


def test_who_comes_second_waits_until_the_first_has_passed(router: Router):
    """The first drives 2 to 6; the second comes from the niche, and behind it."""
    traffic = Traffic(router)
    assert traffic.ask("r0", 2, 3, 4, 5, 6).granted == 4
    niche = traffic.ask("r1", 9, 4)
    assert (niche.granted, niche.holder, niche.aside) == (0, "r0", None) and niche.reason == "r0 drives there"
    behind = traffic.ask("r2", 0, 1, 2, 3, 4, 5)
    assert (behind.granted, behind.holder) == (1, "r0"), "it may close up"
    traffic.ask("r0", 5, 6)
    assert traffic.ask("r1", 9, 4).holder == "", "and drives on when the first has left"
    assert traffic.ask("r2", 1, 2, 3, 4, 5).granted == 2, "now the other one holds the crossing"


def test_beside_each_other_is_room_for_both(router: Router):
    traffic = Traffic(router)
    assert traffic.ask("r0", 0, 1, 2, 3).granted == 3
    assert traffic.ask("r1", 13, 12, 11, 10) == ReserveAnswer(3, "", None, "")


def test_a_robot_that_died_releases_its_way(router: Router):
    traffic = Traffic(router)
    traffic.ask("r0", 3, 4, 5)
    assert traffic.ask("r1", 6, 5, 4).granted == 0
    traffic.now += LEASE - 0.1
    assert traffic.ask("r1", 6, 5, 4).holder == "r0"
    traffic.now += 0.2
    assert traffic.ask("r1", 6, 5, 4) == ReserveAnswer(2, "", None, "")


def test_a_robot_that_has_arrived_releases_its_way(router: Router):
    traffic = Traffic(router)
    traffic.ask("r0", 3, 4, 5)
    traffic.reservations.ask(ReserveRequest("r0", node(5), Pose2(), ()), router, 0.0)
    assert traffic.ask("r1", 6, 5, 4).granted == 2


def test_of_two_head_on_the_later_one_steps_aside_into_the_niche(router: Router):
    traffic = Traffic(router)
    traffic.ask("r0", 1, 2, 3, 4)
    traffic.ask("r1", 7, 6, 5)
    first = traffic.ask("r0", 3, 4, 5, 6, 7, 8)
    second = traffic.ask("r1", 5, 4, 3, 2, 1)
    assert first.granted == 1 and first.holder == "r1"
    assert second.holder == "r0" and second.aside is None, "the first one may be on the way to the niche"
    first = traffic.ask("r0", 3, 4, 5, 6, 7, 8)
    assert (first.granted, first.holder, first.aside) == (0, "r1", None), "it waits, and now leaves it free"
    second = traffic.ask("r1", 5, 4, 3, 2, 1)
    assert second.aside == node(9), "the niche is nearer than the corridor's end"
    assert traffic.ask("r1", 5, 4, 9).granted == 2
    assert traffic.ask("r0", 3, 4, 5, 6, 7, 8).holder == "r1"
    traffic.ask("r1", 9, 9)
    assert traffic.ask("r0", 3, 4, 5, 6, 7, 8).holder == "", "the second is in the niche: the first may pass"
    waits = traffic.ask("r1", 9, 4, 3, 2, 1)
    assert (waits.granted, waits.holder, waits.aside) == (0, "r0", None), "and the second waits there"


def test_the_robot_with_the_shorter_way_aside_steps_aside(router: Router):
    """It set out first, yet stands beside the niche; the other would have to go back by the hall."""
    traffic = Traffic(router)
    traffic.ask("r0", 4, 5, 6, 7, off=0.3)
    traffic.ask("r1", 8, 7)
    for _ in range(2):
        coming = traffic.ask("r1", 7, 6, 5, 4, 3, 2)
        beside = traffic.ask("r0", 4, 5, 6, 7, 8, off=0.3)
    assert (coming.holder, coming.aside) == ("r0", None)
    assert (beside.granted, beside.holder, beside.aside) == (0, "r1", node(9))


def test_a_robot_does_not_step_aside_to_where_the_other_will_box_it_in(router: Router):
    """r1 wants to node 1. Node 0 behind that is nearer to r0 than the niche, and a dead end."""
    traffic = Traffic(router)
    for _ in range(3):
        traffic.ask("r1", 8, 7, 6, 5, 4, 3, 2, 1)
        waits = traffic.ask("r0", 1, 2, 3, 4, 5, 6, 7, 8)
    assert waits.aside == node(9)


def test_no_robot_steps_aside_to_where_a_third_one_waits(router: Router):
    """Two head-on; the niche is nearest, and taken. Both waited for ever, since neither could have it."""
    traffic = Traffic(router)
    traffic.ask("r2", 9, 4, 5)
    for _ in range(3):
        first = traffic.ask("r0", 3, 4, 5, 6, 7)
        second = traffic.ask("r1", 5, 4, 3, 2, 1, 0)
        waits = traffic.ask("r2", 9, 4, 5)
        traffic.now += 1.0
    assert first.aside is None and waits.aside is None
    assert second.holder and second.aside is not None
    assert second.aside == node(8), "the end of the corridor behind it, past where the first one wants to"


def test_robots_side_by_side_may_part(router: Router):
    """They stand nearer to each other than two robots ever pass: away from each other both may drive."""
    traffic = Traffic(router)
    assert traffic.ask("r0", 4, 5, 6, off=0.2).granted == 2
    assert traffic.ask("r1", 4, 5, 6, off=-0.2).holder == "r0", "behind the first one it waits"
    assert traffic.ask("r1", 4, 3, 2, off=-0.2).granted == 2


def test_who_has_parked_holds_its_place_but_not_the_way_past_it(router: Router):
    """At 4, on no way: others drive by, but do not get to where it stands."""
    traffic = Traffic(router)
    parked = NearbyRequest("r9", ((node(4), Pose2(0.1)),), 0.01, 0.01, 0.16, 0.3, 0.3)
    for traffic.now in (0.0, 5.0):
        traffic.nearby.ask(parked, router.merged, traffic.now)
    assert traffic.ask("r1", 6, 5, 4, 3) == ReserveAnswer(3, "", None, "")
    traffic.now += LEASE
    taken = ReserveAnswer(1, "r9", None, "r9 stands at a.1.5", occupied=True)
    assert traffic.ask("r0", 2, 3, 4) == taken
    assert traffic.ask("r9", 4, 5, 4).holder == "", "neither itself nor who waits is in its way"
    assert traffic.ask("r0", 2, 3, 4).reason == "r9 drives there"
    traffic.now = 21.0
    assert traffic.ask("r0", 2, 3, 4) == ReserveAnswer(2, "", None, ""), "it is silent for 16 s"


def test_who_has_parked_in_a_way_is_sent_to_the_nearest_node_off_it(router: Router):
    """At 5 in the corridor, which another one drives along to its end: into the niche."""
    for goal, room in ((8, 9), (5, None), (3, None)):
        traffic = Traffic(router)
        parked = NearbyRequest("r9", ((node(5), Pose2(0.1)),), 0.01, 0.01, 0.16, 0.3, 0.3)
        for traffic.now in (0.0, 5.0):
            traffic.nearby.ask(parked, router.merged, traffic.now)

        def aside(robot: str, traffic: Traffic = traffic) -> NodeId | None:
            return traffic.reservations.room_for(robot, node(5), Pose2(0.1), router, traffic.now)

        traffic.now = 6.0
        assert aside("r9") is None, "no one wants to pass"
        traffic.ask("r0", *range(0, goal + 1))
        assert aside("r9") == (None if room is None else node(room))
        assert aside("r0") is None and aside("r1") is None
        traffic.now += LEASE + 0.1
        assert aside("r9") is None, "who wanted to pass is gone"


def test_of_what_is_not_on_the_map_nothing_is_held(router: Router):
    traffic = Traffic(router)
    assert traffic.ask("r0", 98, 99).granted == 1
    assert traffic.ask("r1", 0, 99).granted == 1


robots = st.sampled_from(["r0", "r1", "r2"])


@pytest.mark.slow
@settings(max_examples=60)
@given(st.lists(st.tuples(robots, st.integers(0, 8), st.integers(0, 3)), max_size=20))
def test_robots_that_drive_no_further_than_granted_never_meet(
    router: Router, drives: list[tuple[str, int, int]]
):
    """By brute force: any robot, to any goal, as far as it likes of what it is granted, in any order."""
    traffic, at, held = Traffic(router), {"r0": 0, "r1": 4, "r2": 8}, dict[str, range]()
    for robot, start in at.items():
        traffic.ask(robot, start)
    for robot, goal, driven in drives:
        step = 1 if goal >= at[robot] else -1
        way = [at[robot], *range(at[robot] + step, goal + step, step)] if goal != at[robot] else [goal]
        granted = traffic.ask(robot, *way).granted if len(way) > 1 else 0
        held[robot] = range(min(way[0], way[0] + step * granted), max(way[0], way[0] + step * granted) + 1)
        at[robot] += step * min(driven, granted)
        for other in held.keys() - {robot}:
            assert not set(held[robot]) & set(held[other]), "nodes are 1 m apart, which is room for two"
