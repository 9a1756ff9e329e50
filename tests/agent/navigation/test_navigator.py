"""Blocked, alone and on the way: what the navigator says, asks and does; the fleet's answers are scripted."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mapweave.agent.mission import ServerAnswer, WhichWay
from mapweave.agent.motion_primitives import NO_ANSWER
from mapweave.agent.navigation import positioning, route_follower
from mapweave.agent.navigation.blocks import Blocks
from mapweave.agent.navigation.navigator import NavigationStage, Navigator
from mapweave.agent.navigation.route_source import onboard_route
from mapweave.agent.settings import NavigatorSettings
from mapweave.hybridmap.drive_statistics import DriveStatistics
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, Obstacle, RelocalizeAnswer, RouteAnswer, RouteLeg
from mapweave.vision.sift import Features
from synthetic.maps import changes_of
from synthetic.world import World, take_map
from tests.agent.scripted_fleet import (
    BODY,
    EXACT,
    FREE,
    NOWHERE,
    TOUR,
    WALL_AHEAD,
    A,
    B,
    C,
    Eyes,
    Trial,
    a_way,
    answering,
    at,
    bare,
    here,
    navigator,
    only_a_to_b,
    straight,
)
from tests.quick import first_quick

# Blocked


def blocked_trial(home: World, forget: float = 15.0) -> tuple[Trial, list[tuple[float, WhichWay]]]:
    """A robot before a wall through which the only way leads; the fleet knows no other."""
    eyes = Eyes(home, Pose2(2.5, 2.0))
    settings = NavigatorSettings(blocked_first=forget, blind_distance=1e9)
    nav = navigator(eyes, NOWHERE, B, settings)
    routes: list[tuple[float, WhichWay]] = []

    def way(question: WhichWay) -> RouteAnswer:
        routes.append((len(trial.commands) * BODY.tick, question))
        return only_a_to_b(question)

    trial = Trial(nav, eyes, answering(way), WALL_AHEAD, held=True)
    return trial, routes


def test_a_blocked_robot_reports_the_obstacle_and_waits(home):
    trial, routes = blocked_trial(home)
    trial.run(40.0, lambda: len(routes) >= 2)
    assert routes[0][1].blocked == ()
    assert routes[1][1].blocked == ((A, B),), "the server hears of it with the next question"
    words = next(detail for stage, detail in trial.said if stage == NavigationStage.BLOCKED)
    assert "0.06 m off" in words and str(A) in words and str(B) in words
    trial.run(1.0)
    assert trial.navigator.stage == NavigationStage.WAITING and "blocked" in trial.navigator.detail
    assert trial.navigator.fix is not None, "it still knows where it is"
    assert trial.navigator.statistics.blocks == 1 and trial.navigator.statistics.relocalizations == 1


@pytest.mark.slow
def test_a_block_is_forgotten_after_a_while_and_for_longer_each_time(home):
    trial, routes = blocked_trial(home, forget=5.0)
    trial.run(200.0, lambda: trial.navigator.statistics.blocks == 3)
    tries = [time for time, question in routes if not question.blocked]
    assert len(tries) >= 3
    begun = [time for time, question in routes if question.blocked and time > 0]
    waits = [min(t for t in tries if t > b) - b for b in (begun[0], min(t for t in begun if t > tries[1]))]
    assert waits[0] == pytest.approx(5.0, abs=3.0)
    assert waits[1] == pytest.approx(10.0, abs=3.0)


@pytest.mark.slow
def test_it_goes_around_by_another_way(home):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    nav = navigator(eyes, NOWHERE, B, NavigatorSettings(blind_distance=1e9))
    answered: list[tuple[NodeId, ...]] = []

    def way(question: WhichWay) -> RouteAnswer:
        route = a_way(A, C, B) if question.blocked else a_way(A, B)
        answered.append(tuple(leg.node.id for leg in route.legs))
        return route

    trial = Trial(nav, eyes, answering(way), WALL_AHEAD, held=True)
    trial.run(40.0, lambda: len(answered) == 2)
    assert answered == [(A, B), (A, C, B)]
    trial.proximity, trial.held = FREE, False
    trial.run(20.0, lambda: nav.statistics.edges > 0)
    assert nav.statistics.edges == 1 and nav.statistics.skipped == 0, "it drove to the node in between"


def held_at_the_goal(
    home: World, monkeypatch: pytest.MonkeyPatch, proximity: np.ndarray = FREE
) -> tuple[Navigator, list[WhichWay]]:
    """A robot that is held almost at the goal until it has asked for a third route; and its questions."""
    eyes = Eyes(home, Pose2(2.5, 2.0))
    monkeypatch.setattr(route_follower, "PARKING_PATIENCE", 3.0)
    nav = navigator(eyes, NOWHERE, B, NavigatorSettings(blind_distance=1e9))
    trial = Trial(nav, eyes, answering(lambda _: a_way(A, B, step=0.3)), proximity, held=True)
    trial.run(20.0, lambda: len(trial.ways) == 3)
    return nav, trial.ways


def test_endless_parking_is_retried_before_it_is_a_block(home, monkeypatch):
    """Almost at the goal, held there by nothing that could block another robot."""
    nav, routes = held_at_the_goal(home, monkeypatch)
    assert [question.blocked for question in routes] == [(), (), ((A, B),)], "no robot is informed at first"
    assert nav.statistics.blocks == 1 and nav.statistics.relocalizations == 2, "then it finds itself rebuilt"


def test_what_is_near_at_the_goal_bars_no_other_way_to_it(home, monkeypatch):
    """Before, the place right before the robot was the goal itself, and for 15 to 120 s no way led there."""
    _, routes = held_at_the_goal(home, monkeypatch, WALL_AHEAD)
    assert routes[-1].blocked == ((A, B),)
    assert [question.obstacles for question in routes] == [()] * 3


def test_blocks_are_kept_for_a_time_that_doubles():
    blocks = Blocks(NavigatorSettings(blocked_first=10.0, blocked_longest=25.0))
    blocks.add(B, A, 0.0)
    assert blocks.pairs(9.9) == ((A, B),) and blocks.pairs(10.0) == ()
    blocks.add(A, B, 20.0)
    assert blocks.pairs(39.9) == ((A, B),) and blocks.pairs(40.0) == ()
    blocks.add(A, B, 50.0)
    blocks.add(B, C, 50.0)
    assert set(blocks.pairs(59.0)) == {(A, B), (B, C)}
    assert blocks.pairs(74.9) == ((A, B),) and blocks.pairs(75.0) == ()


def test_a_pair_may_be_blocked_any_number_of_times():
    blocks = Blocks(NavigatorSettings(blocked_first=10.0, blocked_longest=25.0))
    for _ in range(1100):
        blocks.add(A, B, 0.0)
    assert blocks.pairs(24.9) == ((A, B),) and blocks.pairs(25.0) == ()


def test_the_place_of_another_robot_is_avoided_for_longer_than_the_pair_of_nodes():
    blocks = Blocks(NavigatorSettings(blocked_first=10.0, blocked_longest=25.0))
    thing, robot = Obstacle(A, 0.0, 0.0, 0.2), Obstacle(B, 0.0, 0.0, 0.4, "r7")
    blocks.add(A, B, 0.0, thing)
    blocks.add(B, C, 0.0, robot)
    assert blocks.obstacles(9.9) == (thing, robot) and len(blocks.pairs(9.9)) == 2
    assert blocks.obstacles(10.0) == blocks.obstacles(24.9) == (robot,) and blocks.pairs(10.0) == ()
    assert blocks.obstacles(25.0) == ()


# Alone


def test_without_a_server_its_own_map_leads_the_way(home, own_map):
    goal = max(own_map.nodes)
    eyes = Eyes(home, TOUR[0])
    silent = Trial(
        navigator(eyes, own_map, goal), eyes, lambda question: ServerAnswer(question.number, None, NO_ANSWER)
    )
    silent.run(10.0, lambda: silent.navigator.legs > 0)
    assert silent.navigator.legs == 3
    route = onboard_route(own_map, min(own_map.nodes), goal)
    pose = Pose2()
    for leg in route.legs:
        pose = pose @ leg.previous_from_node.mean
    assert pose.distance(TOUR[0].inverse() @ TOUR[2]) < 0.05
    nodes = sorted(own_map.nodes)
    assert "blocked" in onboard_route(own_map, nodes[0], goal, [(nodes[2], nodes[1])]).reason
    assert "not in the map" in onboard_route(own_map, nodes[0], C).reason


@pytest.mark.parametrize("seen", first_quick([True, False], 1))
def test_a_goal_without_features_is_reached_by_its_neighbours(home, seen):
    """The goal has no landmarks: the robot stands there by what it sees of A, looks again, has arrived.

    Where it sees nothing of A either, it has the fleet's word alone, and that is not enough.
    """
    eyes = Eyes(home, Pose2(2.0, 2.0))
    start = eyes.pose
    nav = navigator(eyes, NOWHERE, B)
    nodes, _ = take_map(home, A.map, [start], np.random.default_rng(2), sigma_xy=0.002)
    node = replace(nodes[0], id=A) if seen else bare(A)
    observations: list[float] = []

    def where() -> RelocalizeAnswer:
        observations.append((start.inverse() @ eyes.pose).x)
        return at(here(A, start.inverse() @ eyes.pose))

    trial = Trial(nav, eyes, answering(lambda _: a_way(node, B, step=0.6), where))
    trial.run(150.0, lambda: nav.arrived or nav.given_up)
    assert nav.arrived == seen
    if not seen:
        assert nav.given_up and f"at node {A}; nothing of it is in view" in nav.detail
        return
    words = re.match(r"at the goal, (\d+) \+- (\d+) mm off, twice by what is seen of nodes", nav.detail)
    assert words is not None, nav.detail
    said, sigma = (float(number) / 1e3 for number in words.groups())
    assert said < 0.03 and 0.0 < sigma < 0.03
    assert (start @ Pose2(0.6)).distance(eyes.pose) < min(0.03, said + 3.0 * sigma)
    assert len(observations) == 2 and observations[1] == pytest.approx(0.6, abs=0.03), (
        "it has looked again at the goal"
    )


def test_a_photograph_of_unknown_distance_is_driven_to_and_a_vague_pose_is_not(home):
    """Another look from the same spot makes a scale no surer; on the way to the photograph it shows."""
    vague = PoseGaussian(Pose2(-0.6), np.diag([0.18**2, 0.18**2, 0.01**2]))
    fixed = []
    for known in (False, True):
        eyes = Eyes(home, Pose2(2.0, 2.0))
        nav = navigator(eyes, NOWHERE, B)
        certainty = Certainty.FOUND if known else Certainty.PLACE
        place = replace(here(A, Pose2()), node_from_robot=vague, distance_known=known)
        answer = RelocalizeAnswer(certainty, (place,), "it looks like a")
        fleet = answering(only_a_to_b, lambda answer=answer: answer)
        Trial(nav, eyes, fleet).run(3.0, lambda nav=nav: nav.fix is not None)
        fixed.append(nav.fix is not None)
    assert fixed == [True, False]


def test_without_landmarks_it_drives_on_a_little_before_it_is_lost(home, monkeypatch):
    """A long way without a view: by wheels twice a little further, and only then it is lost."""
    eyes = Eyes(home, Pose2(0.5, 2.0))
    monkeypatch.setattr(positioning, "FURTHER", 0.5)
    nav = navigator(eyes, NOWHERE, B, NavigatorSettings(blind_distance=1.0))
    observations: list[float] = []
    ahead = RouteLeg(bare(B), PoseGaussian(Pose2(9.0), EXACT), None)

    def way(question: WhichWay) -> RouteAnswer:
        here_first = PoseGaussian(Pose2(), EXACT) if question.start == B else ahead.previous_from_node
        return RouteAnswer((replace(ahead, previous_from_node=here_first),), "a way")

    def where() -> RelocalizeAnswer:
        observations.append(eyes.pose.x - 0.5)
        return at(here(A, Pose2())) if len(observations) == 1 else at()

    trial = Trial(nav, eyes, answering(way, where))
    trial.run(60.0, lambda: nav.stage == NavigationStage.LOST and len(observations) > 3)
    assert observations[1:4] == pytest.approx([1.0, 1.5, 2.0], abs=0.1)
    assert nav.stage == NavigationStage.LOST and nav.fix is None
    assert nav.statistics.relocalizations == 1


def test_a_look_that_shows_nothing_does_not_confirm_that_the_goal_is_reached(home, own_map):
    """Its landmarks are seen once and then no more: a robot that was carried off is not parked at it."""
    goal = min(own_map.nodes)
    eyes = Eyes(home, TOUR[0] @ Pose2(0.1, 0.0, 0.05))
    nav = navigator(eyes, own_map, goal)
    trial = Trial(nav, eyes, lambda question: ServerAnswer(question.number, None, NO_ANSWER))
    trial.run(10.0, lambda: nav.fix is not None)
    assert nav.fix is not None and nav.fix.node == goal
    eyes.world = World(home.points[:1], home.normals[:1], home.vectors[:1])
    trial.run(60.0, lambda: nav.arrived)
    assert not nav.arrived, nav.detail


class BlankAtTheGoal(Eyes):
    """Sees nothing where it looks along x near the second place of the tour."""

    def extract(self, image: np.ndarray, left_out: object = None) -> Features:
        seen = super().extract(image, left_out)
        shown = len(seen) if self.pose.x < TOUR[1].x - 0.45 or abs(self.pose.heading) > 0.9 else 0
        return Features(seen.pixels[:shown], seen.pixels[:shown], seen.codes[:shown], np.ones(shown))


def test_a_goal_before_a_blank_wall_is_reached_by_two_looks_at_what_is_beside_it(home):
    """A look at the goal fails; the robot goes on looking, and what it sees elsewhere is the second."""
    poses = [TOUR[0], TOUR[1], TOUR[1] @ Pose2(0.0, 0.0, 2.6), TOUR[1] @ Pose2(0.0, 0.0, -2.6)]
    nodes, edges = take_map(home, A.map, poses, np.random.default_rng(2), sigma_xy=0.002)
    goal = nodes[1].id
    nodes[1] = replace(nodes[1], landmarks=bare(goal).landmarks)
    eyes = BlankAtTheGoal(home, TOUR[0] @ Pose2(0.1, 0.0, 0.05))
    nav = navigator(eyes, HybridMap(changes_of(nodes, edges)), goal)
    trial = Trial(nav, eyes, lambda question: ServerAnswer(question.number, None, NO_ANSWER))
    trial.run(150.0, lambda: nav.arrived or nav.given_up)
    assert nav.arrived and "its own landmarks" in nav.detail, trial.said
    assert TOUR[1].distance(eyes.pose) < 0.08


def test_a_tally_counts_nodes_that_were_left_before_they_were_reached():
    tally = DriveStatistics().passed([0.2]).passed([]).passed([0.9, 0.3]).passed([1.2])
    assert tally == DriveStatistics(edges=3, skipped=2)


# Without proximity sensors

BARE = replace(BODY, ranger_bearings=(), ranger_reach=0.0)
NO_READINGS = np.zeros(0)


def test_a_touch_blocks_the_edge_and_another_way_is_sought(home):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    nav = navigator(eyes, NOWHERE, B, NavigatorSettings(blind_distance=1e9), BARE)
    trial = Trial(nav, eyes, answering(lambda _: a_way(A, B)), NO_READINGS)
    trial.run(20.0, lambda: any(command.forward > 0.0 for command in trial.commands))
    nav.touch("the bumper is pressed")
    trial.run(20.0, lambda: len(trial.ways) == 2)
    assert [question.blocked for question in trial.ways] == [(), ((A, B),)]
    assert any("something was touched: the bumper is pressed" in detail for _, detail in trial.said)


def undriven(_: WhichWay) -> RouteAnswer:
    """A way from A to B that is known by a link alone."""
    start, last = straight(bare(A), bare(B))
    return RouteAnswer((start, replace(last, kind=EdgeKind.MERGED)), "a way")


@pytest.mark.parametrize("body", [BODY, BARE], ids=["rangers", "no rangers"])
def test_only_driven_edges_are_driven_without_rangers(home, body):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    nav = navigator(eyes, NOWHERE, B, NavigatorSettings(blind_distance=1e9), body)
    trial = Trial(nav, eyes, answering(undriven), FREE if body is BODY else NO_READINGS)
    trial.run(8.0, lambda: len(trial.ways) == 3 or any(c.forward > 0.0 for c in trial.commands))
    drives = any(command.forward > 0.0 for command in trial.commands)
    assert drives == (body is BODY)
    assert trial.ways[-1].blocked == (() if body is BODY else ((A, B),))


def test_a_fleet_that_insists_on_an_undriven_edge_is_asked_seldom_and_the_goal_given_up(home):
    """Before, it was asked at each tick, and the reason was that the robot did not know where it is."""
    eyes = Eyes(home, Pose2(2.5, 2.0))
    nav = navigator(eyes, NOWHERE, B, NavigatorSettings(patience=30.0), BARE)
    trial = Trial(nav, eyes, answering(undriven), NO_READINGS)
    trial.run(40.0)
    assert nav.given_up and f"no robot has driven between {A} and {B}" in nav.detail
    assert len(trial.ways) < 20
