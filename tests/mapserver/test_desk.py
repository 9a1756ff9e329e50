"""The desk: in time or refused, and who is refused comes back when there is room."""

from __future__ import annotations

import itertools
import threading

import pytest

from hybridmap.errors import Busy
from mapserver.desk import Desk, DeskSettings


class Clock:
    """Time that passes when the test says so."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Counter:
    """A desk whose workers are all held up until they are let go."""

    def __init__(self, settings: DeskSettings) -> None:
        self.clock = Clock()
        self.desk = Desk(settings, self.clock)
        self.go = threading.Event()
        self.taken = 0

    def ask(self) -> float:
        """One more question: 0 if it is taken on, else the seconds after which to ask again."""
        try:
            self.desk.submit(lambda: self.go.wait(10))
        except Busy as busy:
            return busy.retry_after
        self.taken += 1
        return 0.0

    def end(self) -> None:
        self.go.set()
        self.desk.close()


@pytest.mark.parametrize(("workers", "seconds", "in_time"), [(1, 0.1, 0.65), (2, 0.05, 0.51), (4, 0.2, 0.23)])
def test_what_is_taken_on_is_answered_in_time(workers: int, seconds: float, in_time: float) -> None:
    counter = Counter(DeskSettings(workers, in_time=in_time, first_guess=seconds))
    while not counter.ask():
        assert counter.taken < 1000
    # The last one taken waits for all that were behind those at work; one more would wait too long.
    behind = counter.taken - workers
    assert behind * seconds / workers + seconds <= in_time or behind == 0
    assert (behind + 1) * seconds / workers + seconds > in_time
    counter.end()


def test_a_free_worker_takes_on_whatever_it_costs() -> None:
    counter = Counter(DeskSettings(2, in_time=0.1, first_guess=5.0))
    assert [counter.ask() > 0.0 for _ in range(4)] == [False, False, True, True]
    counter.end()


def test_a_crowd_that_was_refused_comes_back_one_after_the_other() -> None:
    """Fifty ask at once and keep to what they are told: the queue never fills again."""
    workers, seconds = 2, 0.05
    settings = DeskSettings(workers, in_time=0.5, first_guess=seconds)
    counter = Counter(settings)
    pauses = [pause for pause in (counter.ask() for _ in range(50)) if pause]
    assert counter.taken + len(pauses) == 50
    assert pauses == sorted(pauses)
    gaps = [b - a for a, b in itertools.pairwise(pauses)]
    assert gaps == pytest.approx([seconds / workers] * len(gaps))
    # By hand: from now on one is done each 25 ms, and the refused come as they were told.
    open_ones = counter.taken
    step = seconds / workers
    for k, pause in enumerate(pauses):
        waiting = open_ones + k - pause / step - workers
        assert waiting * step + seconds <= settings.in_time
    assert pauses[-1] < 50 * step + 0.1, "and nobody waits for nothing"
    counter.end()


def test_the_time_that_a_question_takes_is_learned() -> None:
    clock = Clock()
    desk = Desk(DeskSettings(1, first_guess=0.01, smoothing=0.5), clock)

    def work() -> None:
        clock.now += 0.4

    for _ in range(12):
        desk.submit(work).result(5)
    assert desk.counters() == {"answered": 12, "busy": 0, "open": 0, "answer_ms": pytest.approx(400, abs=1)}
    desk.close()


def test_results_and_errors_come_back_and_a_failure_costs_no_worker() -> None:
    for workers in (0, 1):
        desk = Desk(DeskSettings(workers))
        assert desk.submit(lambda: 3 + 4).result(5) == 7
        for _ in range(3):
            with pytest.raises(ZeroDivisionError):
                desk.submit(lambda: 1 / 0).result(5)
        assert desk.submit(lambda: "still here").result(5) == "still here"
        assert desk.counters()["open"] == 0
        desk.close()
        desk.close()


def test_what_has_waited_too_long_is_refused_at_its_turn() -> None:
    """Each question takes four times as long as was thought."""
    clock = Clock()
    settings = DeskSettings(1, in_time=0.6, too_late=1.5, first_guess=0.1)
    desk, go, waited = Desk(settings, clock), threading.Event(), []

    def work(came: float) -> None:
        assert go.wait(10)
        waited.append(clock.now - came)
        clock.now += 0.4

    futures = [desk.submit(lambda: work(100.0)) for _ in range(5)]
    go.set()
    refusals = [future.exception(10) for future in futures]
    assert waited == pytest.approx([0.0, 0.4])
    for refusal in refusals[2:]:
        assert isinstance(refusal, Busy)
        assert 0.0 < refusal.retry_after <= settings.longest_pause
    assert refusals[:2] == [None, None]
    assert desk.counters()["busy"] == 3
    assert desk.counters()["open"] == 0
    desk.close()


def test_closing_finishes_what_was_taken_on() -> None:
    desk = Desk(DeskSettings(1, in_time=60.0))
    done: list[int] = []
    for k in range(20):
        desk.submit(lambda k=k: done.append(k))
    desk.close()
    assert done == list(range(20))


def test_without_workers_the_asker_works_and_nobody_is_refused() -> None:
    desk = Desk(DeskSettings(0, in_time=0.1, first_guess=100.0))
    threads = [desk.submit(threading.current_thread).result() for _ in range(50)]
    assert set(threads) == {threading.current_thread()}
