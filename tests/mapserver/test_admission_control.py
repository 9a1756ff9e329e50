"""Admission control: in time or refused, and refused questions come back when there is room."""

import itertools
import threading

import numpy as np
import pytest

from mapweave.hybridmap.errors import Busy, SettingsError
from mapweave.mapserver import admission_control
from mapweave.mapserver.admission_control import LONGEST_PAUSE, AdmissionControl, AdmissionSettings
from mapweave.mapserver.schedule import LockstepSchedule
from mapweave.storage.settings_file import build
from tests.clock import Clock


class Counter:
    """An admission control whose workers are all held up until released."""

    def __init__(self, settings: AdmissionSettings, seconds: float) -> None:
        self.clock = Clock(100.0)
        self.services = AdmissionControl(settings, self.clock, first_guess=seconds)
        self.go = threading.Event()
        self.taken = self.asked = 0

    def ask(self, ticket: int | None = None) -> float:
        """One more question: 0 if it is taken on, else the seconds after which to ask again."""
        self.asked += 1
        try:
            self.services.submit(lambda: self.go.wait(60), self.asked if ticket is None else ticket)
        except Busy as busy:
            return busy.retry_after
        self.taken += 1
        return 0.0

    def end(self) -> None:
        self.go.set()
        self.services.close()


@pytest.mark.parametrize("workers", [1, 2])
def test_unusual_jobs_do_not_change_the_estimated_duration(workers: int):
    """A person's question takes seconds; no robot is turned away for it afterwards."""
    clock = Clock(100.0)
    admission = AdmissionControl(AdmissionSettings(workers), clock, first_guess=0.1)

    def work() -> None:
        clock.now += 8.0

    admission.submit(work, usual=False).result(20.0)
    assert admission.counters()["answer_ms"] == 100.0 and admission.counters()["answered"] == 1
    admission.submit(work).result(20.0)
    assert float(admission.counters()["answer_ms"]) > 800.0
    admission.close()


@pytest.mark.parametrize(("workers", "seconds", "in_time"), [(1, 0.1, 0.65), (2, 0.05, 0.51), (4, 0.2, 0.23)])
def test_accepted_questions_are_answered_in_time(workers: int, seconds: float, in_time: float):
    counter = Counter(AdmissionSettings(workers, in_time=in_time), seconds)
    while not counter.ask():
        assert counter.taken < 1000
    # The last one taken waits for all that were behind those at work; one more would wait too long.
    behind = counter.taken - workers
    assert behind * seconds / workers + seconds <= in_time or behind == 0
    assert (behind + 1) * seconds / workers + seconds > in_time
    counter.end()


def test_a_free_worker_takes_a_job_of_any_cost():
    counter = Counter(AdmissionSettings(2, in_time=0.1), 5.0)
    assert [counter.ask() > 0.0 for _ in range(4)] == [False, False, True, True]
    counter.end()


def test_a_refused_crowd_comes_back_in_sequence():
    """Fifty ask at once and keep to their retry times: the queue never fills again."""
    workers, seconds = 2, 0.05
    settings = AdmissionSettings(workers, in_time=0.5)
    counter = Counter(settings, seconds)
    pauses = [pause for pause in (counter.ask() for _ in range(50)) if pause]
    assert counter.taken + len(pauses) == 50
    assert pauses == sorted(pauses)
    gaps = [b - a for a, b in itertools.pairwise(pauses)]
    assert gaps == pytest.approx([seconds / workers] * len(gaps))
    # By hand: from now on one is done each 25 ms, and the refused come at their retry times.
    open_ones = counter.taken
    step = seconds / workers
    for k, pause in enumerate(pauses):
        waiting = open_ones + k - pause / step - workers
        assert waiting * step + seconds <= settings.in_time
    assert pauses[-1] < 50 * step + 0.1, "and no client waits for nothing"
    counter.end()


class Simulated:
    """An admission control in simulated time: each question takes as long, and every robot asks on and on.

    Only its own rules are used; the workers and their ends are simulated.
    """

    def __init__(self, robots: int, seconds: float, keep: bool, rng: np.random.Generator) -> None:
        self.clock = Clock(100.0)
        self.services = AdmissionControl(AdmissionSettings(1), self.clock, first_guess=seconds)
        self.pool = self.services._pool
        queue: list[tuple[float, int]] = []  # when it came, and whose it is

        class Waiting:
            def submit(self, _work: object, _call: object, ticket: int, *_rest: object) -> None:
                queue.append((0.0, ticket))

        self.services._pool = Waiting()  # type: ignore[assignment]
        begin = {robot: 100.0 + 0.01 * robot for robot in range(robots)}
        due, number = dict(begin), dict.fromkeys(begin, 0)
        self.waits: list[float] = []
        self.refusals = 0
        free = 100.0
        while self.clock.now < 200.0:
            robot = min(due, key=lambda one: due[one]) if due else None
            if queue and (robot is None or free <= due[robot]):
                self.clock.now = max(self.clock.now, free)
                _, ticket = queue.pop(0)
                done, asker = self.clock.now + seconds, ticket % robots
                free = done
                with self.services._lock:
                    self.services._open -= 1
                self.waits.append(done - begin[asker])
                number[asker] += 1
                begin[asker] = due[asker] = done + rng.uniform(0.0, 0.01)
                continue
            assert robot is not None
            self.clock.now = max(self.clock.now, due[robot])
            ticket = robot + robots * number[robot] if keep else int(rng.integers(1 << 40)) * robots + robot
            try:
                self.services.submit(lambda: None, ticket)
            except Busy as busy:
                self.refusals += 1
                due[robot] = self.clock.now + busy.retry_after
                continue
            if len(queue) == 1:
                free = max(free, self.clock.now)
            del due[robot]
        self.longest = max(self.clock.now - since for since in begin.values())
        self.pool.shutdown()


def test_all_get_a_turn():
    """Fifty robots ask on and on: with appointments, none waits much longer than a round takes."""
    seconds, robots = 0.06, 50
    fair = Simulated(robots, seconds, keep=True, rng=np.random.default_rng(1))
    unfair = Simulated(robots, seconds, keep=False, rng=np.random.default_rng(1))
    whole_round = robots * seconds
    assert max(*fair.waits, fair.longest) < 1.5 * whole_round
    assert unfair.longest > 3.0 * whole_round, "without them, who comes first goes on coming first"
    # The worker is never without work for long, and no question is refused again more than about once.
    assert len(fair.waits) > 0.95 * 100.0 / seconds
    assert fair.refusals < 1.1 * len(fair.waits)


def test_an_appointment_has_precedence_and_expires():
    counter = Counter(AdmissionSettings(1, in_time=0.5), 0.1)
    while not counter.ask():
        pass
    pause = counter.ask(ticket=77)
    assert pause > 0.0
    assert counter.ask(ticket=88) > pause
    counter.clock.now += pause
    # None was served in between: one more would be too late, but an appointment is accepted.
    assert counter.ask(ticket=99) > 0.0
    assert counter.ask(ticket=77) == 0.0
    counter.clock.now += 30.0
    assert counter.ask(ticket=88) > 0.0
    counter.end()


def test_the_time_that_a_question_takes_is_learned(monkeypatch):
    clock = Clock(100.0)
    monkeypatch.setattr(admission_control, "SMOOTHING", 0.5)
    admission = AdmissionControl(AdmissionSettings(1), clock, first_guess=0.01)

    def work() -> None:
        clock.now += 0.4

    for _ in range(12):
        admission.submit(work, 1).result(5)
    took = pytest.approx(400, abs=1)
    assert admission.counters() == {"answered": 12, "busy": 0, "open": 0, "answer_ms": took}
    admission.close()


def test_results_and_errors_come_back_and_a_failure_costs_no_worker():
    for executor in (None, LockstepSchedule().executor(1)):
        admission = AdmissionControl(AdmissionSettings(1), executor=executor)
        assert admission.submit(lambda: 3 + 4, 1).result(5) == 7
        for _ in range(3):
            with pytest.raises(ZeroDivisionError):
                admission.submit(lambda: 1 / 0, 1).result(5)
        assert admission.submit(lambda: "still here", 1).result(5) == "still here"
        assert admission.counters()["open"] == 0
        admission.close()
        admission.close()


def test_questions_that_waited_too_long_are_refused(monkeypatch):
    """Each question takes four times as long as was thought."""
    clock = Clock(100.0)
    monkeypatch.setattr(admission_control, "TOO_LATE", 1.5)
    admission = AdmissionControl(AdmissionSettings(1, in_time=0.6), clock, first_guess=0.1)
    go, waited = threading.Event(), list[float]()

    def work(came: float) -> None:
        assert go.wait(60)
        waited.append(clock.now - came)
        clock.now += 0.4

    futures = [admission.submit(lambda: work(100.0), k) for k in range(5)]
    go.set()
    refusals = [future.exception(10) for future in futures]
    assert waited == pytest.approx([0.0, 0.4])
    for refusal in refusals[2:]:
        assert isinstance(refusal, Busy)
        assert 0.0 < refusal.retry_after <= LONGEST_PAUSE
    assert refusals[:2] == [None, None]
    assert admission.counters()["busy"] == 3
    assert admission.counters()["open"] == 0
    admission.close()


@pytest.mark.parametrize(
    ("name", "value"), [("workers", -1), ("workers", 65), ("in_time", 0.0), ("in_time", float("nan"))]
)
def test_settings_that_cannot_work(name: str, value: float):
    with pytest.raises(SettingsError, match=f"^file: {name}:? .*{value}"):
        build(AdmissionSettings, {name: value}, "file")


def test_closing_finishes_accepted_jobs():
    admission = AdmissionControl(AdmissionSettings(1, in_time=60.0))
    done: list[int] = []
    for k in range(20):
        admission.submit(lambda k=k: done.append(k), k)
    admission.close()
    assert done == list(range(20))


def test_in_lockstep_the_asking_thread_works_and_no_question_is_refused():
    schedule = LockstepSchedule()
    admission = AdmissionControl(
        AdmissionSettings(1, in_time=0.1), schedule.monotonic, schedule.executor(1), first_guess=100.0
    )
    threads = [admission.submit(threading.current_thread, k).result() for k in range(50)]
    assert set(threads) == {threading.current_thread()}
