"""Asking: a busy server is asked again when it said, and a robot's patience has an end. And moving."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from mapweave import Camera, NodeId, Observation, Odometry, RobotDescription
from mapweave.agent.mission import Question, ServerAnswer, WhichWay
from mapweave.agent.motion_primitives import NO_ANSWER, MotionPrimitives
from mapweave.hybridmap.query import RouteAnswer

BODY = RobotDescription(Camera(64, 48, 60, 60, 32, 24, 0.3), tick=0.1)
HERE, THERE = NodeId("r0", 1, 1), NodeId("r1", 1, 1)


def ask(
    fleet: Callable[[int, Question], ServerAnswer | None], patience: int = 100
) -> tuple[ServerAnswer, list[float]]:
    """Ask a way of a fleet that answers the n-th question (from 0) within a tick; when it was asked, s."""
    motion = MotionPrimitives(BODY, patience)
    behaviour = motion.ask(WhichWay(motion.number(), HERE, THERE))
    asked: list[float] = []
    answers: tuple[ServerAnswer, ...] = ()
    while True:
        motion.take_in(Observation(0, Odometry(0.0, 0.0), None), answers)
        try:
            next(behaviour)
        except StopIteration as end:
            return end.value, asked
        answers = ()
        for question in motion.questions():
            asked.append(motion.now)
            answer = fleet(len(asked) - 1, question)
            answers = answers if answer is None else (answer,)


def test_a_busy_server_is_asked_again_at_its_time():
    def fleet(n: int, question: Question) -> ServerAnswer:
        pauses = (0.8, 2.0)
        if n < len(pauses):
            return ServerAnswer(question.number, None, "busy", pauses[n])
        return ServerAnswer(question.number, RouteAnswer((), "here you go"))

    answer, asked = ask(fleet)
    assert isinstance(answer.content, RouteAnswer)
    assert len(asked) == 3
    # An answer is received a tick after the question; a tick is the resolution of time.
    assert asked[1] - asked[0] == pytest.approx(0.9, abs=0.11)
    assert asked[2] - asked[1] == pytest.approx(2.1, abs=0.11)


def test_a_server_that_stays_busy_is_left_with_its_retry_time():
    answer, asked = ask(lambda _, question: ServerAnswer(question.number, None, "busy", 1.5), patience=50)
    assert (answer.content, answer.error, answer.retry_after) == (None, "busy", 1.5)
    assert len(asked) == 4


def test_another_refusal_is_final_and_silence_is_waited_for():
    answer, asked = ask(lambda _, question: ServerAnswer(question.number, None, "no such node"))
    assert (answer.error, len(asked)) == ("no such node", 1)
    answer, asked = ask(lambda *_: None, patience=7)
    assert (answer.error, len(asked)) == (NO_ANSWER, 1)


BEARINGS = tuple(np.linspace(-math.pi, math.pi, 8, endpoint=False).tolist())


@pytest.mark.parametrize(("readings", "most", "freest"), [
    ([1, 1, 1, 1, 1, 2, 3, 2], math.inf, 6),
    ([1, 1, 1, 1, 1, 2, 3, 2], 0.5, 0),
    ([0.3, 0.3, 2, 2, 2, 2.5, 3, 2], 0.5, 2),
])  # fmt: skip
def test_it_goes_where_there_is_most_room_or_enough(readings, most, freest):
    motion = MotionPrimitives(RobotDescription(BODY.camera, ranger_bearings=BEARINGS, ranger_reach=3.0))
    motion.take_in(Observation(0, Odometry(0.0, 0.0), None, np.array(readings, dtype=float)), ())
    way, direction = motion.freest(most)
    assert direction == BEARINGS[freest]
    assert way == min(motion.room(direction), most)
    assert all(min(motion.room(bearing), most) <= way for bearing in BEARINGS)


def test_without_rangers_there_is_no_room():
    motion = MotionPrimitives(BODY)
    motion.take_in(Observation(0, Odometry(0.0, 0.0), None), ())
    assert motion.freest() == (0.0, 0.0)


def test_a_robot_that_cannot_turn_gives_up():
    motion = MotionPrimitives(BODY)
    motion.take_in(Observation(0, Odometry(0.0, 0.0), None), ())
    assert len(list(motion.turn(0.6, 0.6))) <= 32
