"""Lost, blocked and in doubt: what the navigator says, asks and does; the fleet's answers are scripted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agent.blocks import Blocks, BlockSettings
from agent.follower_settings import FollowerSettings
from agent.helm import NO_ANSWER, Helm
from agent.mission import Answer, Question, WhereAmI, WhichWay
from agent.navigator import Navigator, NavigatorSettings, Stage
from agent.observation import Command, Observation, Odometry, RobotDescription
from agent.own_route import own_route
from agent.search import Search, SearchSettings
from agent.tally import Tally
from agent.vision.lens import Lens
from agent.vision.sift import Features
from hybridmap.change import EdgePut, NodePut
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Landmarks, MapId, Node, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.query import Certainty, RelocalizeAnswer, RouteAnswer, RouteLeg, Whereabouts
from hybridmap.synthetic import CAMERA, World, room, take_map, take_view

BEARINGS = tuple(np.linspace(-math.pi, math.pi, 16, endpoint=False).tolist())
BODY = RobotDescription(CAMERA, ranger_bearings=BEARINGS, ranger_reach=3.0)
FREE = np.full(len(BEARINGS), 3.0)
WALL_AHEAD = np.where(np.cos(BEARINGS) > 0.8, 0.06, 3.0)
EXACT = np.diag([1e-4, 1e-4, 1e-5])
IMAGE = np.zeros((240, 320), np.uint8)
TOUR = [Pose2(1.0 + 1.2 * k, 2.0) for k in range(3)]

Fleet = Callable[[Question], Answer]


@pytest.fixture(scope="module")
def home() -> World:
    """A room."""
    return room(0, 0, 5, 4, 900, np.random.default_rng(0))


@pytest.fixture(scope="module")
def own_map(home: World) -> HybridMap:
    """Three nodes in a row, each 1.2 m before the one before."""
    nodes, edges = take_map(home, MapId("r0", 1), TOUR, np.random.default_rng(2), sigma_xy=0.002)
    return HybridMap([*map(NodePut, nodes), *map(EdgePut, edges)])


class Eyes:
    """Sees features of a world from where the robot is; takes the place of Sift."""

    def __init__(self, world: World, pose: Pose2) -> None:
        self.world, self.pose = world, pose
        self.rng = np.random.default_rng(3)

    def extract(self, image: np.ndarray) -> Features:
        view, _ = take_view(self.world, self.pose, self.rng)
        pixels = view.pixels.astype(np.float64)
        return Features(pixels, pixels, view.codes, np.ones(len(view)))


class Trial:
    """A navigator, a body that does what it is told unless it is held, and a scripted fleet."""

    def __init__(
        self, navigator: Navigator, eyes: Eyes, fleet: Fleet, proximity: np.ndarray = FREE, held: bool = False
    ) -> None:
        self.navigator, self.eyes, self.fleet = navigator, eyes, fleet
        self.proximity, self.held = proximity, held
        self.asked: list[Question] = []
        self.commands: list[Command] = []
        self.said: list[tuple[str, str]] = []
        self._moved = Odometry(0.0, 0.0)
        self._answers: tuple[Answer, ...] = ()

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        for tick in range(round(seconds / BODY.tick)):
            observation = Observation(tick * 100_000_000, self._moved, IMAGE, self.proximity)
            command, questions = self.navigator.step(observation, self._answers)
            self.commands.append(command)
            saying = (str(self.navigator.stage), self.navigator.detail)
            if not self.said or self.said[-1] != saying:
                self.said.append(saying)
            self.asked += questions
            self._answers = tuple(map(self.fleet, questions))
            share = 0.0 if self.held else BODY.tick
            self._moved = Odometry(command.forward * share, command.turn * share)
            self.eyes.pose = self.eyes.pose @ self._moved.motion()
            if until():
                return


def navigator(
    eyes: Eyes, own: HybridMap, goal: NodeId, settings: NavigatorSettings | None = None
) -> Navigator:
    return Navigator(BODY, Lens(BODY), eyes, own, goal, settings)  # type: ignore[arg-type]


def here(node: NodeId, node_from_robot: Pose2) -> Whereabouts:
    return Whereabouts(node, PoseGaussian(node_from_robot, EXACT), None, 0, 30, 0.99)


def found(question: Question, *places: Whereabouts) -> Answer:
    """One place is found; several are ambiguous; none is unknown."""
    certainty = (Certainty.UNKNOWN, Certainty.FOUND)[len(places)] if len(places) < 2 else Certainty.AMBIGUOUS
    return Answer(question.number, RelocalizeAnswer(certainty, places, "it may be a or b"))


def bare(node_id: NodeId) -> Node:
    """A node that shows nothing."""
    rng = np.random.default_rng(0)
    nodes, _ = take_map(room(0, 0, 5, 4, 1, rng), node_id.map, [Pose2()], rng)
    some = nodes[0].landmarks
    landmarks = Landmarks(some.pixels[:0], some.codes[:0], some.depths[:0], some.depth_sigmas[:0])
    return replace(nodes[0], id=node_id, landmarks=landmarks)


A, B, C = (NodeId("s", 1, number) for number in (1, 3, 5))
NOWHERE = HybridMap()


def straight(start: Node, *others: Node, step: float = 1.5) -> tuple[RouteLeg, ...]:
    """A route whose nodes stand one behind the other, straight ahead."""
    legs = [RouteLeg(start, PoseGaussian(Pose2(), np.zeros((3, 3))), None)]
    return (*legs, *(RouteLeg(node, PoseGaussian(Pose2(step), EXACT), None) for node in others))


# In doubt


def test_an_ambiguous_view_is_never_taken_for_a_place(home):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    trial = Trial(
        navigator(eyes, NOWHERE, C), eyes,
        lambda question: found(question, here(A, Pose2()), here(B, Pose2())),
    )  # fmt: skip
    trial.run(60.0)
    assert trial.navigator.fix is None
    assert all(isinstance(question, WhereAmI) for question in trial.asked)
    assert any(detail.startswith("ambiguous: it may be a or b") for _, detail in trial.said)


def test_it_drives_elsewhere_to_tell_two_places_apart(home):
    """Near the start all views are alike; from 0.5 m away they are not."""
    start = Pose2(2.5, 2.0)
    eyes = Eyes(home, start)

    def fleet(question: Question) -> Answer:
        if isinstance(question, WhichWay):
            return Answer(question.number, RouteAnswer(straight(bare(A), bare(C)), "a way"))
        if start.distance(eyes.pose) < 0.5:
            return found(question, here(A, Pose2()), here(B, Pose2()))
        return found(question, here(A, Pose2(0.1, 0.2, 0.3)))

    trial = Trial(navigator(eyes, NOWHERE, C), eyes, fleet)
    trial.run(60.0, lambda: trial.navigator.fix is not None)
    assert trial.navigator.fix is not None and trial.navigator.fix.node == A
    assert any("driving on to look from elsewhere" in detail for _, detail in trial.said)
    assert trial.navigator.tally == Tally(relocalizations=1)
    turned = sum(abs(command.turn) for command in trial.commands) * BODY.tick
    assert turned > math.tau, "first it looked all around"


def test_without_room_it_stays_and_looks_on(home):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    trial = Trial(
        navigator(eyes, NOWHERE, C), eyes,
        lambda question: found(question, here(A, Pose2()), here(B, Pose2())), proximity=np.full(16, 0.1),
    )  # fmt: skip
    trial.run(60.0)
    assert all(command.forward == 0.0 for command in trial.commands)
    assert trial.navigator.fix is None


def test_two_own_nodes_that_look_the_same_are_not_told_apart_by_guessing(home):
    """The same view hangs in two rooms of the own map: the fleet is asked, and knows no better."""
    nodes, _ = take_map(home, MapId("r0", 1), [TOUR[0]] * 2, np.random.default_rng(4), sigma_xy=0.002)
    first = nodes[0]
    far = PoseGaussian(first.map_from_robot.mean @ Pose2(0.0, 8.0), first.map_from_robot.covariance)
    alike = HybridMap([NodePut(first), NodePut(replace(nodes[1], map_from_robot=far))])
    eyes = Eyes(home, TOUR[0])
    alone = Trial(navigator(eyes, HybridMap([NodePut(first)]), C), eyes, found)
    alone.run(2.0)
    assert alone.navigator.tally.relocalizations, "one of them alone is recognised at once"
    eyes = Eyes(home, TOUR[0])
    trial = Trial(navigator(eyes, alike, C), eyes, found)
    trial.run(2.0)
    assert not trial.navigator.tally.relocalizations and trial.navigator.fix is None
    assert any(isinstance(question, WhereAmI) for question in trial.asked)


def test_a_place_that_another_robot_knows_a_twin_of_is_not_taken_either(home, own_map):
    """The own map alone would be sure; the fleet knows another room that looks the same."""
    eyes = Eyes(home, TOUR[0])
    trial = Trial(
        navigator(eyes, own_map, C), eyes,
        lambda question: found(question, here(min(own_map.nodes), Pose2()), here(B, Pose2())),
    )  # fmt: skip
    trial.run(30.0)
    assert not trial.navigator.tally.relocalizations


def test_the_fleet_is_believed_where_it_contradicts_the_own_map(home, own_map):
    eyes = Eyes(home, TOUR[0])
    trial = Trial(
        navigator(eyes, own_map, C), eyes, lambda question: found(question, here(B, Pose2(0.1, 0.0, 0.2)))
    )
    trial.run(2.0, lambda: trial.navigator.fix is not None)
    assert trial.navigator.fix is not None and trial.navigator.fix.node == B


def test_a_silent_fleet_is_not_waited_for_at_each_look(home):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    navigator_ = navigator(eyes, NOWHERE, C)
    trial = Trial(navigator_, eyes, lambda question: Answer(question.number, None, NO_ANSWER))
    trial.run(18.0)
    assert len(trial.asked) == 1
    trial.run(15.0)
    assert len(trial.asked) == 2


# Blocked


def blocked_trial(home: World, forget: float = 15.0) -> tuple[Trial, list[tuple[float, WhichWay]]]:
    """A robot before a wall through which the only way leads; the fleet knows no other."""
    eyes = Eyes(home, Pose2(2.5, 2.0))
    settings = NavigatorSettings(blocks=BlockSettings(forget=forget), follower=FollowerSettings(blind=1e9))
    nav = navigator(eyes, NOWHERE, B, settings)
    routes: list[tuple[float, WhichWay]] = []

    def fleet(question: Question) -> Answer:
        if isinstance(question, WhereAmI):
            return found(question, here(A, Pose2()))
        routes.append((len(trial.commands) * BODY.tick, question))
        if {A, B} in [set(pair) for pair in question.blocked]:
            return Answer(question.number, RouteAnswer((), "every way is blocked"))
        return Answer(question.number, RouteAnswer(straight(bare(A), bare(B)), "a way"))

    trial = Trial(nav, eyes, fleet, WALL_AHEAD, held=True)
    return trial, routes


def test_a_blocked_robot_says_what_blocks_it_reports_it_and_waits(home):
    trial, routes = blocked_trial(home)
    trial.run(40.0, lambda: len(routes) >= 2)
    assert routes[0][1].blocked == ()
    assert routes[1][1].blocked == ((A, B),), "the server hears of it with the next question"
    words = next(detail for stage, detail in trial.said if stage == Stage.BLOCKED)
    assert "0.06 m off" in words and str(A) in words and str(B) in words
    trial.run(1.0)
    assert trial.navigator.stage == Stage.WAITING and "blocked" in trial.navigator.detail
    assert trial.navigator.fix is not None, "it still knows where it is"
    assert trial.navigator.tally.blocks == 1 and trial.navigator.tally.relocalizations == 1


def test_a_block_is_forgotten_after_a_while_and_for_longer_each_time(home):
    trial, routes = blocked_trial(home, forget=5.0)
    trial.run(200.0, lambda: trial.navigator.tally.blocks == 3)
    tries = [time for time, question in routes if not question.blocked]
    assert len(tries) >= 3
    begun = [time for time, question in routes if question.blocked and time > 0]
    waits = [min(t for t in tries if t > b) - b for b in (begun[0], min(t for t in begun if t > tries[1]))]
    assert waits[0] == pytest.approx(5.0, abs=3.0)
    assert waits[1] == pytest.approx(10.0, abs=3.0)


def test_it_goes_around_by_another_way(home):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    nav = navigator(eyes, NOWHERE, B, NavigatorSettings(follower=FollowerSettings(blind=1e9)))
    answered: list[tuple[NodeId, ...]] = []

    def fleet(question: Question) -> Answer:
        if isinstance(question, WhereAmI):
            return found(question, here(A, Pose2()))
        legs = straight(bare(A), bare(C), bare(B)) if question.blocked else straight(bare(A), bare(B))
        answered.append(tuple(leg.node.id for leg in legs))
        return Answer(question.number, RouteAnswer(legs, "a way"))

    trial = Trial(nav, eyes, fleet, WALL_AHEAD, held=True)
    trial.run(40.0, lambda: len(answered) == 2)
    assert answered == [(A, B), (A, C, B)]
    trial.proximity, trial.held = FREE, False
    trial.run(20.0, lambda: nav.tally.edges > 0)
    assert nav.tally.edges == 1 and nav.tally.skipped == 0, "it drove to the node in between"


def test_parking_that_comes_to_no_end_is_tried_anew_before_it_is_a_block(home):
    """Almost at the goal, held there by nothing that anybody else could meet."""
    eyes = Eyes(home, Pose2(2.5, 2.0))
    follower = FollowerSettings(blind=1e9, parking_patience=3.0)
    nav = navigator(eyes, NOWHERE, B, NavigatorSettings(follower=follower))
    routes: list[WhichWay] = []

    def fleet(question: Question) -> Answer:
        if isinstance(question, WhereAmI):
            return found(question, here(A, Pose2()))
        routes.append(question)
        return Answer(question.number, RouteAnswer(straight(bare(A), bare(B), step=0.3), "a way"))

    trial = Trial(nav, eyes, fleet, held=True)
    trial.run(20.0, lambda: len(routes) == 3)
    assert [question.blocked for question in routes] == [(), (), ((A, B),)], "nobody is told at first"
    assert nav.tally.blocks == 1 and nav.tally.relocalizations == 2, "then it finds itself anew"


def test_blocks_are_kept_for_a_time_that_doubles():
    blocks = Blocks(BlockSettings(forget=10.0, longest=25.0))
    blocks.add(B, A, 0.0)
    assert blocks.at(9.9) == ((A, B),) and blocks.at(10.0) == ()
    blocks.add(A, B, 20.0)
    assert blocks.at(39.9) == ((A, B),) and blocks.at(40.0) == ()
    blocks.add(A, B, 50.0)
    blocks.add(B, C, 50.0)
    assert set(blocks.at(59.0)) == {(A, B), (B, C)}
    assert blocks.at(74.9) == ((A, B),) and blocks.at(75.0) == ()


# Alone


def test_without_a_server_its_own_map_leads_the_way(home, own_map):
    goal = max(own_map.nodes)
    eyes = Eyes(home, TOUR[0])
    silent = Trial(
        navigator(eyes, own_map, goal), eyes, lambda question: Answer(question.number, None, NO_ANSWER)
    )
    silent.run(10.0, lambda: silent.navigator.legs > 0)
    assert silent.navigator.legs == 3
    route = own_route(own_map, min(own_map.nodes), goal)
    pose = Pose2()
    for leg in route.legs:
        pose = pose @ leg.previous_from_node.mean
    assert pose.distance(TOUR[0].inverse() @ TOUR[2]) < 0.05
    nodes = sorted(own_map.nodes)
    assert "blocked" in own_route(own_map, nodes[0], goal, [(nodes[2], nodes[1])]).reason
    assert "not in the map" in own_route(own_map, nodes[0], C).reason


# On the way


def test_a_robot_that_has_lost_sight_of_everything_looks_where_nodes_nearby_have_looked(home, own_map):
    """It stands at a node, turned away from what that shows: one turn finds it, not a turn all around."""
    turned = 2.4
    eyes = Eyes(home, TOUR[1] @ Pose2(0.05, 0.0, turned))
    helm = Helm(BODY, 50)
    search = Search(
        BODY, Lens(BODY), eyes, own_map, helm, SearchSettings(), np.random.default_rng(0)  # type: ignore[arg-type]
    )  # fmt: skip
    # The wheels' belief is off by a little.
    believed = TOUR[0].inverse() @ TOUR[1] @ Pose2(0.1, -0.05, turned + 0.08)
    behaviour, moved, way, fix = search.look_around(believed), Odometry(0.0, 0.0), 0.0, None
    answers: tuple[Answer, ...] = ()
    for tick in range(200):
        helm.take_in(Observation(tick * 100_000_000, moved, IMAGE, FREE), answers)
        try:
            command = next(behaviour)
        except StopIteration as stop:
            fix = stop.value
            break
        answers = tuple(map(found, helm.questions()))
        moved, way = Odometry(0.0, command.turn * BODY.tick), way + command.turn * BODY.tick
        eyes.pose = eyes.pose @ moved.motion()
    assert fix is not None
    assert way == pytest.approx(-turned, abs=0.3), "the shorter way round, and no further"
    true = own_map.nodes[fix.node].map_from_robot.mean.inverse() @ (TOUR[0].inverse() @ eyes.pose)
    assert fix.node_from_robot.mean.distance(true) < 0.1


def test_a_goal_that_shows_nothing_is_reached_by_its_neighbours_and_said_to_be(home):
    """The goal has no landmarks: the robot stands there by what it knows of A, looks again, has arrived."""
    eyes = Eyes(home, Pose2(2.0, 2.0))
    start = eyes.pose
    nav = navigator(eyes, NOWHERE, B)
    goal = bare(B)
    looks: list[float] = []

    def fleet(question: Question) -> Answer:
        if isinstance(question, WhichWay):
            leg = RouteLeg(goal, PoseGaussian(Pose2(0.6) if question.start == A else Pose2(), EXACT), None)
            return Answer(question.number, RouteAnswer((leg,), "a way"))
        looks.append((start.inverse() @ eyes.pose).x)
        return found(question, here(A, start.inverse() @ eyes.pose))

    trial = Trial(nav, eyes, fleet)
    trial.run(60.0, lambda: nav.arrived)
    assert nav.arrived and "its own landmarks" in nav.detail
    assert (start @ Pose2(0.6)).distance(eyes.pose) < 0.03
    assert len(looks) == 2 and looks[1] == pytest.approx(0.6, abs=0.03), "it has looked again at the goal"


def test_where_it_sees_nothing_it_knows_it_drives_on_a_little_before_it_counts_as_lost(home):
    """A long way without a view: by wheels as far as `blind`, twice `further`, and only then it is lost."""
    eyes = Eyes(home, Pose2(0.5, 2.0))
    settings = NavigatorSettings(follower=FollowerSettings(blind=1.0), further=0.5, looks=2)
    nav = navigator(eyes, NOWHERE, B, settings)
    looks: list[float] = []
    ahead = RouteLeg(bare(B), PoseGaussian(Pose2(9.0), EXACT), None)

    def fleet(question: Question) -> Answer:
        if isinstance(question, WhichWay):
            here_first = PoseGaussian(Pose2(), EXACT) if question.start == B else ahead.previous_from_node
            legs = (replace(ahead, previous_from_node=here_first),)
            return Answer(question.number, RouteAnswer(legs, "a way"))
        looks.append(eyes.pose.x - 0.5)
        return found(question, here(A, Pose2())) if len(looks) == 1 else found(question)

    trial = Trial(nav, eyes, fleet)
    trial.run(60.0, lambda: nav.stage == Stage.LOST and len(looks) > 3)
    assert looks[1:4] == pytest.approx([1.0, 1.5, 2.0], abs=0.1)
    assert nav.stage == Stage.LOST and nav.fix is None
    assert nav.tally.relocalizations == 1


# The helm


def test_a_robot_that_cannot_turn_gives_up():
    helm = Helm(BODY, 5)
    helm.take_in(Observation(0, Odometry(0.0, 0.0), None, FREE), ())
    assert len(list(helm.turn(0.6, 0.6))) <= 32


def test_an_overdue_answer_is_none():
    helm = Helm(BODY, 5)
    helm.take_in(Observation(0, Odometry(0.0, 0.0), None, FREE), ())
    asking = helm.ask(WhichWay(helm.number(), A, B))
    with pytest.raises(StopIteration) as stop:
        for _ in range(10):
            next(asking)
    assert stop.value.value.content is None and "server" in stop.value.value.error
    assert len(helm.questions()) == 1


def test_a_tally_counts_nodes_that_were_left_before_they_were_reached():
    tally = Tally().passed([0.2]).passed([]).passed([0.9, 0.3]).passed([1.2])
    assert tally == Tally(edges=3, skipped=2)
