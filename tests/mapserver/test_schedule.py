"""Schedules: the same jobs in the same order, on threads or driven in lock-step."""

import threading
import time

import pytest

from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.schedule import GIVEN_WAY, OVERDUE, LiveSchedule, LockstepSchedule, Schedule
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import encode
from tests.waiting import eventually


def ended(schedule: Schedule) -> None:
    """It has ended, and may be closed twice."""
    assert schedule.close() and schedule.close()


@pytest.mark.parametrize("make", [LiveSchedule, LockstepSchedule])
def test_posted_jobs_run_in_order_and_a_defect_in_one_ends_no_other(make: type[Schedule], caplog):
    schedule, done = make(), list[int]()

    def fails() -> None:
        raise ZeroDivisionError("a defect")

    schedule.start()
    for k in range(50):
        schedule.post(lambda k=k: done.append(k))
        schedule.post(fails)
    schedule.catch_up()
    eventually(lambda: done == list(range(50)))
    ended(schedule)
    assert "a background job failed" in caplog.text


def test_closing_interrupts_a_long_job_at_its_next_pause_and_drops_what_waits(caplog):
    schedule, began, undone = LiveSchedule(), threading.Event(), list[str]()

    def long_job() -> None:
        began.set()
        while True:
            time.sleep(0.001)
            schedule.pause()

    schedule.post(long_job)
    schedule.post(lambda: undone.append("waited"))
    schedule.start()
    assert began.wait(30.0)
    ended(schedule)
    assert undone == []
    assert caplog.text == "", "this is no defect"


def test_closing_says_when_something_still_runs(monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.schedule.ENDING", 0.05)
    schedule, began, go = LiveSchedule(), threading.Event(), threading.Event()

    def without_pause() -> None:
        began.set()
        go.wait(60.0)

    schedule.post(without_pause)
    schedule.start()
    assert began.wait(30.0)
    assert not schedule.close()
    go.set()
    eventually(schedule.close)


@pytest.mark.parametrize("make", [LiveSchedule, LockstepSchedule])
def test_idle_work_goes_on_until_nothing_is_left(make: type[Schedule]):
    schedule, left = make(), [5]

    def idle() -> float | None:
        if not left[0]:
            return None
        left[0] -= 1
        return 0.001

    schedule.idle(idle)
    schedule.start()
    schedule.post(lambda: None)
    schedule.catch_up()
    eventually(lambda: left[0] == 0)
    ended(schedule)


def test_idle_work_is_not_put_off_for_ever_by_jobs_that_keep_coming():
    schedule, ran, stop = LiveSchedule(), threading.Event(), threading.Event()
    schedule.idle(ran.set)
    schedule.start()

    def flood() -> None:
        if not stop.is_set():
            time.sleep(0.002)
            schedule.post(flood)

    began = time.monotonic()
    flood()
    assert ran.wait(20.0)
    assert time.monotonic() - began >= 0.9 * OVERDUE
    stop.set()
    ended(schedule)


def test_periodic_jobs_do_not_wait_for_long_ones():
    schedule, beats, go = LiveSchedule(), list[float](), threading.Event()
    schedule.every(0.01, lambda: beats.append(schedule.monotonic()))
    schedule.start()
    schedule.post(lambda: go.wait(20.0) and None)
    eventually(lambda: len(beats) >= 3)
    go.set()
    ended(schedule)
    count = len(beats)
    time.sleep(0.05)
    assert len(beats) == count


def test_in_lockstep_work_runs_on_demand_in_simulated_time():
    schedule, done = LockstepSchedule(), list[str]()
    schedule.every(1.0, lambda: done.append("beat"))
    schedule.start()
    schedule.post(lambda: done.append("job"))
    schedule.observe(900_000_000)
    schedule.observe(100_000_000)
    assert done == [] and schedule.monotonic() == pytest.approx(0.9)
    with schedule.executor(4) as executor:
        asked = executor.submit(lambda: [*done, "answer"])
        assert asked.result(0) == ["job", "answer"]
        schedule.observe(1_000_000_000)
        failing = executor.submit(lambda: 1 // 0)
        assert isinstance(failing.exception(0), ZeroDivisionError)
    assert done == ["job", "beat"]
    schedule.observe(1_900_000_000)
    schedule.catch_up()
    assert done == ["job", "beat"] and schedule.time_ns() == 1_900_000_000


def test_in_lock_step_time_passes_while_nothing_is_mapped(tmp_path):
    """Leases of robots that only drive expire by it."""
    schedule, keys, hub = LockstepSchedule(), Keys("demo"), MemoryHub()
    status = AgentStatus(Status("driving", "", 3, 40, Pose2(), False), 7_000_000_000, "r0", 1)
    robot, bus = MemoryBus(hub), MemoryBus(hub)
    with MapServer(bus, keys, tmp_path / "s.mapweave", "s0", schedule=schedule):
        robot.publish(keys.agent_status("r0"), encode(status))
        eventually(lambda: schedule.monotonic() == 7.0)
    robot.close()
    bus.close()


def test_the_background_gives_way_and_is_not_starved():
    schedule, busy, done = LiveSchedule(), threading.Event(), list[float]()
    busy.set()
    schedule.give_way(busy.is_set)
    schedule.start()
    began = time.monotonic()
    for _ in range(3):
        schedule.post(lambda: done.append(time.monotonic()))
    eventually(lambda: len(done) == 3)
    assert done[2] - began >= 3 * GIVEN_WAY, "each job waits"

    def long() -> None:
        began = time.monotonic()
        for _ in range(3):
            schedule.pause()
        done.append(time.monotonic() - began)

    schedule.post(long)
    eventually(lambda: len(done) == 4)
    assert done[3] >= 3 * GIVEN_WAY, "and each piece of a long one"
    busy.clear()
    schedule.close()
