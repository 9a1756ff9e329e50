"""Which robots time waits for, without threads or clocks."""

import logging
from dataclasses import dataclass, field

from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.drivers.messages import AGAIN, StepRequest
from mapweave.agent.observation import Command
from mapweave.sim.lockstep import StepBarrier


@dataclass
class Question:
    """A request that remembers its answers."""

    key: str = "k"
    payload: bytes = b""
    answers: list[bytes] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)

    def reply(self, payload: bytes) -> None:
        self.answers.append(payload)

    def refuse(self, reason: str, retry_after: float = 0.0) -> None:
        self.refusals.append(reason)


class Table:
    """A lock-step with names for what the tests do all the time."""

    def __init__(self, robots: list[str]) -> None:
        self.steps = StepBarrier(robots, patience=20.0)

    def ask(self, name: str, sequence: int, now: float = 0.0) -> Question:
        question = Question()
        self.steps.receive(name, StepRequest(sequence, Command()), question, now)
        return question

    def due(self, now: float = 0.0) -> list[str]:
        return [seat.name for seat in self.steps.due(now)]

    def tick(self, now: float = 0.0) -> list[str]:
        seats = self.steps.due(now)
        for seat in seats:
            self.steps.answer(seat, f"{seat.name}@{now}".encode(), now)
        return [seat.name for seat in seats]


def test_time_begins_when_all_have_asked():
    table = Table(["b", "a"])
    assert table.due() == []
    table.ask("b", 1)
    assert table.due(19.9) == []
    table.ask("a", 1)
    assert table.tick() == ["a", "b"]


def test_absent_robots_are_given_up(caplog):
    table = Table(["a", "b"])
    table.ask("a", 1, now=5.0)
    assert table.due(24.9) == []
    assert table.tick(25.0) == ["a"]
    warned = [r.message for r in caplog.records if r.levelno == logging.WARNING]
    assert warned == ["robot b has not asked for 20 s: time begins without it"]
    # A latecomer takes part from the next tick on.
    late = table.ask("b", 1, now=26.0)
    assert table.due(26.0) == []
    table.ask("a", 2, now=26.0)
    assert table.tick(26.0) == ["a", "b"]
    assert late.answers


def test_robots_that_the_start_waits_for_are_logged(caplog):
    caplog.set_level(logging.INFO, "mapweave.sim")
    table = Table(["a", "b", "c"])
    table.ask("b", 1, now=5.0)
    for now in (5.1, 9.0, 12.0):
        assert table.due(now) == []
    assert [r.message for r in caplog.records] == ["time waits for the agents of a, c, 20 s at the longest"]


def test_the_silent_robot_stands_still_until_it_asks_again(caplog):
    table = Table(["a", "b"])
    table.ask("a", 1)
    table.ask("b", 1)
    table.tick(0.0)
    # b takes a minute, but no robot waits for it until a asks.
    table.ask("a", 2, now=60.0)
    assert table.due(79.9) == []
    assert table.tick(80.0) == ["a"]
    assert [r.message for r in caplog.records] == [
        "robot b has not asked for 20 s: it stands still until it asks again"
    ]
    table.ask("a", 3, now=80.1)
    assert table.tick(80.1) == ["a"]
    table.ask("b", 2, now=80.2)
    assert table.due(80.2) == []
    table.ask("a", 4, now=80.3)
    assert table.tick(80.3) == ["a", "b"]
    assert len(caplog.records) == 1


def test_retries_do_not_prolong_the_wait_for_others():
    table = Table(["a", "b"])
    table.ask("a", 1)
    table.ask("b", 1)
    table.tick(0.0)
    for second in range(1, 20, 3):
        table.ask("a", 2, now=float(second))
        assert table.due(float(second)) == []
    assert table.due(21.0) == ["a"]


def test_a_repeated_step_gets_the_same_answer_and_moves_nothing():
    table = Table(["a"])
    first = table.ask("a", 1)
    table.tick(1.0)
    again = table.ask("a", 1, now=2.0)
    assert first.answers == again.answers == [b"a@1.0"]
    assert table.due(2.0) == []


def test_of_a_step_asked_twice_the_newer_question_is_answered():
    table = Table(["a", "b"])
    first, second = table.ask("a", 1), table.ask("a", 1)
    assert AGAIN in first.refusals[0]
    table.ask("b", 1)
    table.tick(3.0)
    assert (first.answers, second.answers, second.refusals) == ([], [b"a@3.0"], [])


def test_an_old_step_is_refused_and_the_first_resets():
    table = Table(["a"])
    for sequence in (1, 2, 3):
        table.ask("a", sequence)
        table.tick(float(sequence))
    assert table.ask("a", 2).refusals == ["step 2 is over, the last was 3"]
    assert table.due() == []
    # An agent that was started again counts from 1.
    restarted = table.ask("a", 1)
    table.tick(9.0)
    assert restarted.answers == [b"a@9.0"]
    table.ask("a", 2)
    assert table.due() == ["a"]


def test_time_does_not_wait_for_the_dead():
    table = Table(["a", "b"])
    table.steps.presence("b", 7, True)
    table.ask("a", 1)
    table.ask("b", 1)
    table.tick()
    table.ask("a", 2)
    assert table.due() == []
    table.steps.presence("b", 7, False)
    assert table.tick() == ["a"]
    assert table.steps.active == {"a"}
    # Its successor is alive before the news of the death arrives: nothing changes for it.
    table.steps.presence("b", 8, True)
    table.ask("b", 1)
    table.steps.presence("b", 7, False)
    assert table.steps.active == {"a", "b"}


def test_the_question_of_a_dead_agent_moves_nothing():
    table = Table(["a", "b"])
    table.steps.presence("b", 7, True)
    question = table.ask("b", 1)
    table.steps.presence("b", 7, False)
    assert AGAIN in question.refusals[0]
    table.ask("a", 1)
    assert table.due() == ["a"]
    table.steps.presence("stranger", 1, True)
    table.steps.presence("stranger", 1, False)


def test_the_end_refuses_everyone_once():
    table = Table(["a", "b"])
    question = table.ask("b", 1)
    assert table.steps.refuse_all("over") == {"b"}
    assert table.steps.refuse_all("over") == set()
    assert question.refusals == ["over"]


@given(st.permutations(["a", "b", "c", "d"]), st.lists(st.permutations(["a", "b", "c", "d"]), max_size=5))
def test_the_order_of_asking_does_not_matter(robots: list[str], orders: list[list[str]]):
    table = Table(robots)
    for number, order in enumerate(orders, 1):
        for name in order:
            assert table.due() == []
            table.ask(name, number)
        assert table.tick() == ["a", "b", "c", "d"]
