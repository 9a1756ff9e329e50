"""Robots let each other pass: what one does when its way is held, and two of them head-on in a corridor."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from mapweave.agent.localization.fix import Fix
from mapweave.agent.mission import MayIDrive, Question, ServerAnswer, WhichWay
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.navigation.goal_patience import YIELDED
from mapweave.agent.navigation.navigator import NavigationStage
from mapweave.agent.navigation.right_of_way import Passage, RightOfWay
from mapweave.agent.observation import Command, Observation, Odometry
from mapweave.agent.robots_in_view import RobotBeside
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.nearby import NearbyRequest
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import ReserveAnswer, RouteAnswer
from mapweave.mapserver.nearby import Nearby
from mapweave.mapserver.reservations import Reservations
from tests.agent.reserving_robot import BLIND, reserving_robot
from tests.agent.scripted_fleet import (
    BODY,
    FREE,
    NOWHERE,
    A,
    B,
    C,
    Eyes,
    Fleet,
    Trial,
    a_way,
    answering,
    at,
    here,
    navigator,
)
from tests.mapserver.test_reservations import node, router  # noqa: F401 - a fixture


def trial_to(home, goal=B) -> Trial:
    """A robot at A, whose fleet knows the way to any node: straight ahead."""
    eyes = Eyes(home, Pose2(1.0, 2.0))

    def way(question: WhichWay) -> RouteAnswer:
        blocked = {A, B} in map(set, question.blocked)
        return RouteAnswer((), "blocked") if blocked else a_way(A, question.goal)

    return Trial(navigator(eyes, NOWHERE, goal, BLIND), eyes, answering(way))


def let_drive(question: MayIDrive) -> ServerAnswer:
    return ServerAnswer(question.number, ReserveAnswer(2, "", None, ""))


def test_a_robot_whose_way_is_held_stands_and_says_so_and_then_drives_on(home):
    trial, free = trial_to(home), [False]
    asked: list[MayIDrive] = []

    def traffic(question: MayIDrive) -> ServerAnswer:
        asked.append(question)
        granted = len(question.route) if free[0] else 0
        words = "" if free[0] else "r7 drives there"
        return ServerAnswer(question.number, ReserveAnswer(granted, "" if free[0] else "r7", None, words))

    trial.traffic = traffic
    trial.run(10.0)
    assert trial.navigator.stage == NavigationStage.YIELDING and trial.navigator.detail == "r7 drives there"
    assert not any(command.forward for command in trial.commands)
    assert 6 <= len(asked) <= 10, "it asks every second"
    assert asked[-1].route[-1] == B and asked[-1].start == A
    free[0] = True
    trial.run(5.0)
    assert any(command.forward for command in trial.commands[-30:])


def test_a_robot_that_is_held_on_its_way_knows_where_it_stopped(home):
    """Before, it forgot what it had driven in the last tick before it stopped: 26 mm each time."""
    trial = trial_to(home)
    for granted in (2, 0, 2, 0):
        trial.traffic = lambda question, n=granted: ServerAnswer(
            question.number, ReserveAnswer(n, "" if n else "r7", None, "r7 drives there")
        )
        trial.run(2.5)
    fix = trial.navigator.fix
    assert fix is not None and fix.node == A
    assert trial.commands[-1] == Command() and 0.3 < trial.eyes.pose.x - 1.0 < 1.4
    assert fix.node_from_robot.mean.x == pytest.approx(trial.eyes.pose.x - 1.0, abs=1e-6)


def test_a_robot_that_waits_too_long_looks_for_another_way(home):
    trial = trial_to(home)
    trial.traffic = lambda question: ServerAnswer(question.number, ReserveAnswer(0, "r7", None, ""))
    trial.run(YIELDED + 8.0)
    assert [question.blocked for question in trial.ways][:2] == [(), ((A, B),)]


def test_a_robot_that_a_person_drives_meanwhile_has_not_waited():
    """Before, it gave a goal up for which it had waited 5 s, once the person let it go on."""
    motion = MotionPrimitives(BODY)
    right_of_way = RightOfWay(motion, [A, B])
    fix = Fix(A, PoseGaussian(Pose2(), np.zeros((3, 3))))
    asked: list[Question] = []

    def tick() -> None:
        held = ReserveAnswer(0, "r7", None, "r7 stands there", occupied=True)
        observation = Observation(0, Odometry(0.0, 0.0), None, FREE)
        motion.take_in(observation, tuple(ServerAnswer(question.number, held) for question in asked))

    def waits(seconds: float) -> set[Passage]:
        out = set()
        for _ in range(round(seconds / BODY.tick)):
            tick()
            out.add(right_of_way.passage(1, fix))
            asked[:] = motion.questions()
        return out

    assert waits(5.0) == {Passage.HELD}
    for _ in range(round(2.0 * YIELDED / BODY.tick)):
        tick()
    assert waits(YIELDED - 6.0) == {Passage.HELD}
    assert waits(2.0) == {Passage.HELD, Passage.STUCK}


def test_a_robot_whose_goal_is_taken_waits_and_then_gives_up(home):
    """Before, it manoeuvred beside the parked robot for 300 s, with "no progress, though nothing is near"."""
    trial = trial_to(home)
    taken = ReserveAnswer(0, "r7", None, f"r7 stands at {B}", occupied=True)
    trial.traffic = lambda question: ServerAnswer(question.number, taken)
    trial.run(YIELDED - 5.0)
    assert trial.navigator.stage == NavigationStage.YIELDING and trial.navigator.detail == f"r7 stands at {B}"
    trial.run(10.0)
    assert trial.navigator.given_up and trial.navigator.detail == f"r7 stands at {B}"
    assert not any(command.forward for command in trial.commands)


def test_a_robot_steps_aside_and_asks_for_its_way_again(home):
    trial = trial_to(home)
    aside = ReserveAnswer(0, "r7", C, "")
    trial.traffic = lambda question: (
        let_drive(question) if question.route[-1] == C else ServerAnswer(question.number, aside)
    )
    trial.run(4.0)
    goals = [question.goal for question in trial.ways]
    assert goals[:2] == [B, C] and trial.navigator.stage == NavigationStage.ASIDE
    assert re.fullmatch(rf"r7 is to pass; \d\.\d\d m to node {C}", trial.navigator.detail)
    trial.traffic = let_drive
    trial.run(20.0, lambda: len(trial.asked) > 3)
    assert trial.asked[-1].goal == B


def test_a_robot_in_the_way_is_named(home):
    trial = trial_to(home)
    r7 = RobotBeside(0.2, "r7", 0.5, 0.0, 0.14)
    trial.navigator = navigator(trial.eyes, NOWHERE, B, BLIND, beside=lambda: r7)
    trial.traffic, trial.held = let_drive, True
    trial.run(60.0, lambda: trial.navigator.stage == NavigationStage.BLOCKED)
    assert trial.navigator.detail == f"between {A} and {B}: no progress; r7 is 0.2 m off"


@pytest.mark.parametrize("reserved", [True, False])
def test_two_robots_head_on_in_a_corridor(home, router, reserved):  # noqa: F811
    """Each wants to where the other comes from. With reservations one lets the other pass, in the niche.

    They drive by exact wheels and see nothing, so what keeps them apart is the reservation alone.
    """
    poses, reservations = router.roads.poses, Reservations(Nearby().standing)
    gaps, goals = [], [node(8), node(0)]
    robots = [
        reserving_robot(home, router, reservations, name, *ends, lambda: len(gaps) * BODY.tick, facing)
        for name, ends, facing in (("r0", goals[::-1], 0.0), ("r1", goals, math.pi))
    ]
    if not reserved:
        for trial in robots:
            trial.traffic = lambda question: ServerAnswer(question.number, None)

    def there(trial: Trial, goal) -> bool:
        return trial.eyes.pose.distance(poses[goal]) < 0.3

    for _ in range(2400):
        for trial in robots:
            trial.run(BODY.tick)
        gaps.append(robots[0].eyes.pose.distance(robots[1].eyes.pose))
        if all(map(there, robots, goals)):
            break
    if reserved:
        assert len(gaps) * BODY.tick < 80.0, "32 s without the other one"
        assert all(map(there, robots, goals)), "both are where they wanted to be"
        assert min(gaps) > 2 * BODY.radius, "and have not touched"
        said = {stage for trial in robots for stage, _ in trial.said}
        assert NavigationStage.ASIDE in said and NavigationStage.YIELDING in said
    else:
        assert min(gaps) < 2 * BODY.radius, "without reservations they drive into each other"


@pytest.mark.slow
def test_a_parked_robot_makes_room_in_a_corridor_and_the_other_passes(home, router):  # noqa: F811
    """One has parked in the middle, another one drives from end to end; both by exact wheels."""
    poses, nearby = router.roads.poses, Nearby()
    reservations = Reservations(nearby.standing)
    clock = [0.0]

    def robot(name: str, start: int, goal: int) -> Trial:
        ends = node(start), node(goal)
        return reserving_robot(home, router, reservations, name, *ends, lambda: clock[0])

    driving, parked, room = robot("r0", 0, 8), robot("r1", 5, 5), None
    gaps: list[float] = []
    for tick in range(1200):
        clock[0] = tick * BODY.tick
        place = ((node(5), poses[node(5)].inverse() @ parked.eyes.pose),)
        if tick % 5 == 0:
            nearby.ask(NearbyRequest("r1", place, 0.01, 0.01, BODY.radius, 0.3, 0.3), router.merged, clock[0])
        if room is None and tick % 5 == 0:
            room = reservations.room_for("r1", *place[0], router, clock[0])
            if room is not None:
                pose = parked.eyes.pose
                parked = robot("r1", 5, room.number - 1)
                parked.eyes.pose = pose
        driving.run(BODY.tick)
        if room is not None:
            parked.run(BODY.tick)
        gaps.append(driving.eyes.pose.distance(parked.eyes.pose))
        if driving.eyes.pose.distance(poses[node(8)]) < 0.3:
            break
    assert room == node(9), "the niche"
    assert len(gaps) * BODY.tick < 60.0, "32 s without the other one"
    assert driving.eyes.pose.distance(poses[node(8)]) < 0.3
    assert min(gaps) > 2 * BODY.radius, "they have not touched"


def test_a_robot_whose_way_is_closed_asks_for_another_one_at_once(home):
    trial = trial_to(home)
    closed = ReserveAnswer(0, "", None, "the way ahead is closed by anna: wet floor", closed=True)
    trial.traffic = lambda question: ServerAnswer(question.number, ReserveAnswer(1, "", None, ""))
    trial.run(3.0)
    assert len(trial.ways) == 1 and trial.commands[-1].forward > 0.0, "it is on its way"
    trial.traffic = lambda question: ServerAnswer(question.number, closed)
    trial.run(3.0, lambda: len(trial.asked) > 2)
    _, second = trial.ways
    assert second.goal == B and second.blocked == (), "closed is not blocked"
    assert any("closed by anna" in detail for _, detail in trial.said)
    trial.run(0.5)
    trial.traffic = lambda question: ServerAnswer(question.number, ReserveAnswer(1, "", None, ""))
    trial.run(3.0)
    assert any(command.forward or command.turn for command in trial.commands[-10:]), "and goes on by it"


def in_a_row(eyes: Eyes, poses: dict[NodeId, float]) -> Fleet:
    """A fleet that knows nodes in a row, m from A, and where the robot is."""

    def way(question: WhichWay) -> RouteAnswer:
        step = poses[question.goal] - poses[question.start]
        return a_way(question.start, question.goal, step=step)

    return answering(way, lambda: at(here(A, Pose2(eyes.pose.x - 1.0))))


def test_a_robot_passes_what_it_must_in_order_and_then_seeks_its_goal(home):
    eyes, poses = Eyes(home, Pose2(1.0, 2.0)), {A: 0.0, B: 1.0, C: 2.0}
    goal = NodeId("s", 1, 7)
    poses[goal] = 0.5

    trial = Trial(navigator(eyes, NOWHERE, goal, BLIND, via=(B, C)), eyes, in_a_row(eyes, poses))
    trial.run(60.0, lambda: any(question.goal == goal for question in trial.ways))
    assert list(dict.fromkeys(question.goal for question in trial.ways)) == [B, C, goal]
    assert eyes.pose.x - 1.0 == pytest.approx(poses[C], abs=0.35), "it has been at the last before it turns"


@pytest.mark.slow
def test_a_robot_that_goes_to_and_fro_gives_up_neither_for_time_nor_for_way(home):
    """Before, it gave up once its stops took more way than 50 m, or its patience: it drove no new edge."""
    eyes, poses = Eyes(home, Pose2(1.0, 2.0)), {A: 0.0, B: 1.0}

    nav = navigator(eyes, NOWHERE, C, replace(BLIND, patience=30.0), via=(B, A) * 50)
    trial = Trial(nav, eyes, in_a_row(eyes, poses))
    trial.run(600.0, lambda: trial.navigator.given_up or trial.navigator.passed > 50)
    assert trial.navigator.passed > 50, trial.navigator.detail


def test_a_robot_that_stands_in_the_only_way_is_named_and_the_goal_given_up(home):
    """Before, it tried again for 300 s."""
    trial = trial_to(home)
    reach = BODY.radius + 0.14
    r7 = RobotBeside(0.2, "r7", reach + 0.2, 0.0, 0.14)
    trial.navigator = navigator(trial.eyes, NOWHERE, B, BLIND, beside=lambda: r7)
    trial.traffic, trial.held = let_drive, True
    trial.run(70.0, lambda: trial.navigator.given_up)
    seconds = len(trial.commands) * BODY.tick
    assert YIELDED < seconds < 65.0, "of these 30 s until parking counts as blocked"
    assert trial.navigator.detail == f"r7 stands in the way between {A} and {B}, and there is no other"
    (obstacle,) = trial.ways[1].obstacles
    assert obstacle.node == A and obstacle.reach == pytest.approx(BODY.radius + 0.14 + 0.1)
    assert (obstacle.x, obstacle.y) == pytest.approx((r7.x, r7.y), abs=0.05), "it has not moved from A"


def test_a_robot_that_has_left_the_way_again_ends_no_goal(home):
    trial, r7 = trial_to(home), RobotBeside(0.2, "r7", 0.5, 0.0, 0.14)
    around = [r7]
    trial.navigator = navigator(trial.eyes, NOWHERE, B, BLIND, beside=lambda: around[0] if around else None)
    plain = trial.fleet

    def fleet(question: Question) -> ServerAnswer:
        if isinstance(question, WhichWay) and question.obstacles:
            return ServerAnswer(question.number, RouteAnswer((), "blocked"))
        return plain(question)

    trial.fleet = fleet
    trial.traffic, trial.held = let_drive, True
    trial.run(60.0, lambda: trial.navigator.stage == NavigationStage.BLOCKED)
    assert trial.navigator.stage == NavigationStage.BLOCKED
    around.clear()
    trial.run(60.0)
    assert not trial.navigator.given_up


def test_the_reason_of_a_longer_way_is_said_all_along_it(home):
    trial = trial_to(home)
    plain = trial.fleet

    def fleet(question: Question) -> ServerAnswer:
        answer = plain(question)
        if isinstance(answer.content, RouteAnswer):
            return replace(answer, content=replace(answer.content, detour="r7 stands on a shorter way"))
        return answer

    trial.fleet = fleet
    trial.traffic = let_drive
    trial.run(8.0)
    driving = [detail for stage, detail in trial.said if stage == "driving along the route"]
    assert len(driving) > 5 and all(detail.endswith("r7 stands on a shorter way") for detail in driving)
