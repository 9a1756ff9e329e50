"""Lost, and in doubt: what the navigator takes for a place, and how it looks for one."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave import Certainty, HybridMap, MapId, Observation, Odometry, Pose2, PoseGaussian, RelocalizeAnswer
from mapweave.agent.global_localization import candidates
from mapweave.agent.global_localization.candidates import FleetMapSource, OwnMapSource
from mapweave.agent.global_localization.global_localization import TO_NAVIGATE, GlobalLocalization
from mapweave.agent.mission import ServerAnswer, WhereAmI
from mapweave.agent.motion_primitives import NO_ANSWER, MotionPrimitives
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.drive_statistics import DriveStatistics
from mapweave.registration.recognition import Recognition
from mapweave.vision.sift import Features
from synthetic.world import take_map
from tests.agent.scripted_fleet import (
    BODY,
    FREE,
    IMAGE,
    NOWHERE,
    TOUR,
    A,
    B,
    C,
    Eyes,
    Trial,
    a_way,
    answering,
    at,
    found,
    here,
    navigator,
)


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

    def where() -> RelocalizeAnswer:
        alike = start.distance(eyes.pose) < 0.5
        return at(here(A, Pose2()), here(B, Pose2())) if alike else at(here(A, Pose2(0.1, 0.2, 0.3)))

    trial = Trial(navigator(eyes, NOWHERE, C), eyes, answering(lambda _: a_way(A, C), where))
    trial.run(60.0, lambda: trial.navigator.fix is not None)
    assert trial.navigator.fix is not None and trial.navigator.fix.node == A
    assert any("driving on to search from elsewhere" in detail for _, detail in trial.said)
    assert trial.navigator.statistics == DriveStatistics(relocalizations=1)
    turned = sum(abs(command.turn) for command in trial.commands) * BODY.tick
    assert turned > math.tau, "first it looked all around"


@pytest.mark.parametrize("moves_along", [True, False])
def test_views_that_prove_nothing_alone_are_a_place_once_they_agree(home, moves_along):
    """The fleet is not sure. It is believed from the second view on if its answers turn with the wheels."""
    start = Pose2(2.5, 2.0)
    eyes = Eyes(home, start)

    def where() -> RelocalizeAnswer:
        place = here(A, start.inverse() @ eyes.pose if moves_along else Pose2(0.1, 0.2, 0.3))
        return RelocalizeAnswer(Certainty.UNKNOWN, (place,), "not sure")

    trial = Trial(navigator(eyes, NOWHERE, C), eyes, answering(lambda _: a_way(A, C), where))
    trial.run(12.0, lambda: trial.navigator.fix is not None)
    assert (trial.navigator.fix is not None) == moves_along
    if moves_along:
        assert sum(isinstance(question, WhereAmI) for question in trial.asked) == 2


def test_without_room_it_stays_and_searches_on(home):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    trial = Trial(
        navigator(eyes, NOWHERE, C), eyes,
        lambda question: found(question, here(A, Pose2()), here(B, Pose2())), proximity=np.full(16, 0.1),
    )  # fmt: skip
    trial.run(60.0)
    assert all(command.forward == 0.0 for command in trial.commands)
    assert trial.navigator.fix is None


def test_two_similar_own_nodes_are_ambiguous(home):
    """The same view hangs in two rooms of the own map: the fleet is asked, and knows no better."""
    nodes, _ = take_map(home, MapId("r0", 1), [TOUR[0]] * 2, np.random.default_rng(4), sigma_xy=0.002)
    first = nodes[0]
    far = PoseGaussian(first.map_from_robot.mean @ Pose2(0.0, 8.0), first.map_from_robot.covariance)
    alike = HybridMap([NodePut(first), NodePut(replace(nodes[1], map_from_robot=far))])
    eyes = Eyes(home, TOUR[0])
    alone = Trial(navigator(eyes, HybridMap([NodePut(first)]), C), eyes, found)
    alone.run(2.0)
    assert alone.navigator.statistics.relocalizations, "one of them alone is recognised at once"
    eyes = Eyes(home, TOUR[0])
    trial = Trial(navigator(eyes, alike, C), eyes, found)
    trial.run(2.0)
    assert not trial.navigator.statistics.relocalizations and trial.navigator.fix is None
    assert any(isinstance(question, WhereAmI) for question in trial.asked)


@pytest.mark.parametrize("order", [1, -1])
def test_the_most_certain_of_some_nodes_comes_first(own_map, monkeypatch, order):
    """A node from afar shows as many landmarks as the one at which the robot stands."""
    near, far, *_ = own_map.nodes.values()
    recalled = [
        (
            node,
            Recognition(
                PoseGaussian.from_sigmas(Pose2(), xy, heading), np.zeros((inliers, 2), np.int64), 40, 40, {}
            ),
        )
        for node, inliers, xy, heading in ((near, 34, 0.006, 0.005), (far, 36, 0.012, 0.006))[::order]
    ]
    monkeypatch.setattr(candidates, "recognise_places", lambda *_: recalled)
    source = OwnMapSource(own_map, np.random.default_rng(0))
    nothing = Features(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 32), np.uint8), np.zeros(0))
    first, second = source.candidates(nothing.view(BODY.camera), IMAGE, nothing).places
    assert (first.node, second.node) == (near.id, far.id)


def test_a_place_with_a_twin_in_another_robots_map_is_not_accepted(home, own_map):
    """The own map alone would be sure; the fleet knows another room that looks the same."""
    eyes = Eyes(home, TOUR[0])
    trial = Trial(
        navigator(eyes, own_map, C), eyes,
        lambda question: found(question, here(min(own_map.nodes), Pose2()), here(B, Pose2())),
    )  # fmt: skip
    trial.run(30.0)
    assert not trial.navigator.statistics.relocalizations


def test_the_fleet_has_priority_over_the_own_map(home, own_map):
    eyes = Eyes(home, TOUR[0])
    trial = Trial(
        navigator(eyes, own_map, C), eyes, lambda question: found(question, here(B, Pose2(0.1, 0.0, 0.2)))
    )
    trial.run(2.0, lambda: trial.navigator.fix is not None)
    assert trial.navigator.fix is not None and trial.navigator.fix.node == B


def test_a_silent_fleet_is_not_asked_at_each_view(home):
    eyes = Eyes(home, Pose2(2.5, 2.0))
    navigator_ = navigator(eyes, NOWHERE, C)
    trial = Trial(navigator_, eyes, lambda question: ServerAnswer(question.number, None, NO_ANSWER))
    trial.run(18.0)
    assert len(trial.asked) == 1
    trial.run(15.0)
    assert len(trial.asked) == 2


def test_a_robot_that_has_lost_all_landmarks_turns_to_headings_of_nearby_nodes(home, own_map):
    """It stands at a node, turned away from what that shows: one turn finds it, not a turn all around."""
    turned = 2.4
    eyes = Eyes(home, TOUR[1] @ Pose2(0.05, 0.0, turned))
    motion = MotionPrimitives(BODY, 50)
    own = OwnMapSource(own_map, np.random.default_rng(0))
    lost = GlobalLocalization(BODY, eyes, motion, own, TO_NAVIGATE, FleetMapSource(motion))  # type: ignore[arg-type]
    # The wheels' belief is off by a little.
    estimated = TOUR[0].inverse() @ TOUR[1] @ Pose2(0.1, -0.05, turned + 0.08)
    behaviour, moved, way, fix = lost.search(estimated), Odometry(0.0, 0.0), 0.0, None
    answers: tuple[ServerAnswer, ...] = ()
    for tick in range(200):
        motion.take_in(Observation(tick * 100_000_000, moved, IMAGE, FREE), answers)
        try:
            command = next(behaviour)
        except StopIteration as stop:
            fix = stop.value
            break
        answers = tuple(map(found, motion.questions()))
        moved, way = Odometry(0.0, command.turn * BODY.tick), way + command.turn * BODY.tick
        eyes.pose = eyes.pose @ moved.motion()
    assert fix is not None
    assert way == pytest.approx(-turned, abs=0.3), "the shorter way round, and no further"
    true = own_map.nodes[fix.node].map_from_robot.mean.inverse() @ (TOUR[0].inverse() @ eyes.pose)
    assert fix.node_from_robot.mean.distance(true) < 0.1
