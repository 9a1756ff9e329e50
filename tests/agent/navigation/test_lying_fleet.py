"""A fleet that lies: each answer is tried with care, refuted by what the robot sees, and given up.

`python -m benchmarks.trust` does the same with the whole agent in the simulator, judged by the truth.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave import NodeId, Observation, Odometry, Pose2, PoseGaussian, RelocalizeAnswer
from mapweave.agent.global_localization.refuted_places import RefutedPlaces
from mapweave.agent.localization.fix import TURN_SHARE, Fix
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.navigation.answer_trial import TRIALS, AnswerTrial
from mapweave.agent.settings import NavigatorSettings
from synthetic.world import take_map
from tests.agent.scripted_fleet import (
    BODY,
    NOWHERE,
    A,
    B,
    Eyes,
    Trial,
    a_way,
    answering,
    at,
    bare,
    here,
    navigator,
    straight,
)
from tests.quick import first_quick

START = Pose2(1.0, 2.0)
BLIND = NavigatorSettings().blind_distance


def effort(trial: Trial) -> float:
    """Way driven and turned, m."""
    return sum(abs(c.forward) + TURN_SHARE * abs(c.turn) for c in trial.commands) * BODY.tick


def real_node(home, pose: Pose2, node_id: NodeId):
    """A node of what the robot really sees from a pose."""
    nodes, _ = take_map(home, node_id.map, [pose], np.random.default_rng(2), sigma_xy=0.002)
    return replace(nodes[0], id=node_id)


def test_a_place_of_which_nothing_is_in_view_is_refuted_and_given_up(home):
    """The same wrong answer for ever. Before, the robot drove on by it until its patience ended, 300 s."""
    eyes = Eyes(home, START)
    trial = Trial(navigator(eyes, NOWHERE, B), eyes, answering(lambda _: a_way(A, B, step=9.0)))
    trial.run(200.0, lambda: trial.navigator.given_up)
    assert trial.navigator.given_up and trial.navigator.refuted == TRIALS
    reason = f"says that the robot is at node {A}; nothing of it is in view after {BLIND:.1f} m"
    assert f"{TRIALS} answers in a row were wrong" in trial.navigator.detail
    assert reason in trial.navigator.detail
    assert effort(trial) < TRIALS * BLIND + 15.0, "and a turn around between them"
    assert any(f"again node {A}, of which nothing was in view" in detail for _, detail in trial.said)


def test_places_that_contradict_each_other_end_the_same_way(home):
    """Another node each time, of which nothing is in view."""
    eyes = Eyes(home, START)
    asked = iter(range(1, 10_000, 2))
    fleet = answering(
        lambda question: a_way(question.start, B, step=9.0),
        lambda: at(here(NodeId("s", 1, next(asked)), Pose2(0.1))),
    )
    trial = Trial(navigator(eyes, NOWHERE, B), eyes, fleet)
    trial.run(200.0, lambda: trial.navigator.given_up)
    assert trial.navigator.given_up and effort(trial) < TRIALS * BLIND + 15.0


@pytest.mark.parametrize("wrong", [Pose2(0.35, 0.35, 0.0), Pose2(0.0, 0.0, math.pi / 2)])
def test_the_own_view_corrects_a_wrong_pose_before_the_robot_drives(home, wrong):
    """The right node, half a metre or 90 degrees off: the robot sees the node itself."""
    eyes = Eyes(home, START)
    node, true = real_node(home, START @ Pose2(-0.3), A), Pose2(0.3)
    fleet = answering(lambda _: a_way(node, B, step=3.0), lambda: at(here(A, true @ wrong)))
    trial = Trial(navigator(eyes, NOWHERE, B), eyes, fleet)
    trial.run(10.0, lambda: any(command.forward for command in trial.commands))
    fix = trial.navigator.fix
    assert fix is not None and fix.node == A
    assert fix.node_from_robot.mean.distance(START.inverse() @ eyes.pose @ true) < 0.1
    assert abs(fix.node_from_robot.mean.heading - (START.inverse() @ eyes.pose).heading) < 0.05


@pytest.mark.parametrize("apart", first_quick([0.4, 0.0], 1))
def test_answers_that_agree_with_the_wheels_are_not_called_wrong(home, apart):
    """The robot sees nothing of its nodes, but each answer has it where the wheels say that it is by now.

    Before, it gave up a right goal after 12 m: places that it knew only from other sides.
    """
    eyes, goal = Eyes(home, START), START @ Pose2(20.0)
    asked = iter(range(1, 10_000, 2))

    def where() -> RelocalizeAnswer:
        node = NodeId("s", 1, next(asked))
        return at(here(node, Pose2(0.0, apart * (node.number % 4 - 2))))

    fleet = answering(lambda question: a_way(question.start, B, step=(eyes.pose.inverse() @ goal).x), where)
    trial = Trial(navigator(eyes, NOWHERE, B), eyes, fleet)
    trial.run(200.0, lambda: trial.navigator.given_up or eyes.pose.distance(goal) < 0.3)
    assert trial.navigator.given_up == bool(apart), "contradicting answers are given up as before"
    assert (eyes.pose.distance(goal) < 0.3) != bool(apart)


@pytest.mark.parametrize(("step", "bound"), [(9.0, 50.0 + 5.0 * 9.0), (1e4, 550.0)])
def test_no_mission_takes_more_way_than_its_bound(step, bound):
    """However often nodes of its routes are seen: a goal may move away for ever."""
    motion = MotionPrimitives(BODY)
    trial = AnswerTrial(motion, RefutedPlaces(motion))
    route = straight(bare(A), bare(B), step=step)
    for tick in range(600):
        trial.took(route, Fix(A, PoseGaussian(Pose2(), np.zeros((3, 3)))))
        trial.saw(B)
        motion.take_in(Observation(tick, Odometry(1.0, 0.0)), ())
        assert bool(trial.ended) == (motion.way > bound)
    assert "600 m of driving and turning for a route of" in trial.ended
