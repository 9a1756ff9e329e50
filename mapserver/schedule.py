"""When the server's work runs and what time it is: on threads by the machine's clock, or in lock-step.

Merging, answering and what is done now and then hand their work to a schedule. Robots get `LiveSchedule`. A
repeatable simulation drives the same parts by `LockstepSchedule`, where time stops and work runs in the
calling thread, in the order in which it was handed over.

The intake of changes (log/ingest.py) has a thread and a clock of its own: what it takes in does not depend on
them, and lock-step waits until all of it is taken. So has the place index above 100 000 landmarks, which no
repeatable simulation reaches.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import ParamSpec, Protocol, TypeVar

log = logging.getLogger(__name__)

Job = Callable[[], None]
IdleJob = Callable[[], float | None]
"""Does a piece of work that can wait. Returns how long to pause, s; None: nothing is left to do."""
QUIET = 0.02
"""Idle work begins when nothing was posted for so long, s: a burst is taken in as a whole."""
GIVEN_WAY = 0.1
"""Longest pause for what is more urgent, s: jobs and their pieces take 4 to 20 ms, so a twentieth to a sixth
of the speed is left where something always is."""
ENDING = 30.0
"""Longest wait at the end for a piece of work, s: a pose graph of 100 000 nodes is solved meanwhile."""
GLANCE = 0.002
"""Time between two looks whether it goes on, s."""
OVERDUE = 2.0
"""Idle work that could not begin for so long since jobs kept coming goes before them, s."""

_P = ParamSpec("_P")
_T = TypeVar("_T")


class Schedule(Protocol):
    """Runs jobs. All methods may be called from any thread."""

    def monotonic(self) -> float:
        """A clock that only grows, s."""

    def time_ns(self) -> int:
        """Wall time, ns since 1970."""

    def observe(self, stamp_ns: int) -> None:
        """Take note of the time that a robot's message carries."""

    def post(self, job: Job) -> None:
        """Have a job run in the background, one after the other."""

    def idle(self, job: IdleJob) -> None:
        """Run a job in the background whenever no posted job waits. There is one such job."""

    def every(self, period: float, job: Job) -> None:
        """Have a job run every so many seconds, however busy the background is."""

    def executor(self, workers: int) -> Executor:
        """Where questions are answered; the caller shuts it down."""

    def catch_up(self) -> None:
        """Called before a question is answered: in lock-step all that was posted is done first."""

    def give_way(self, busy: Callable[[], bool]) -> None:
        """Hold the background back as long as something more urgent goes on, a little at each pause."""

    def pause(self) -> None:
        """Called in the background, before each job and between the pieces of a long one."""

    def start(self) -> None:
        """Start. Idempotent."""

    def close(self) -> bool:
        """End; returns whether nothing of it runs any more. Idempotent.

        Jobs that wait may be dropped and the one that runs may be interrupted at its next pause: what the
        background makes is derived from the record, and made again at the next start.
        """


class _Ended(BaseException):
    """Interrupts the job that runs when the schedule is closed."""


def _run(job: Job) -> None:
    try:
        job()
    except Exception:  # a defect in one job must not end all others
        log.exception("a background job failed")


class LiveSchedule:
    """Threads and the machine's clock."""

    def __init__(self) -> None:
        """Prepare; nothing runs yet."""
        self._changed = threading.Condition()
        self._jobs: deque[Job] = deque()
        self._idle: IdleJob | None = None
        self._idle_wanted = False
        self._busy: Callable[[], bool] = lambda: False
        self._rest_until = self._quiet_at = self._waiting_since = -math.inf
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="background", daemon=True)
        self._periodic: list[threading.Thread] = []

    def monotonic(self) -> float:
        """The machine's monotonic clock."""
        return time.monotonic()

    def time_ns(self) -> int:
        """The machine's time."""
        return time.time_ns()

    def observe(self, stamp_ns: int) -> None:
        """Nothing: robots' clocks are no measure of the server's."""

    def post(self, job: Job) -> None:
        """Have a job run on the background thread."""
        with self._changed:
            self._jobs.append(job)
            self._changed.notify()

    def idle(self, job: IdleJob) -> None:
        """Have one job run on the background thread whenever no posted job waits."""
        self._idle = job

    def every(self, period: float, job: Job) -> None:
        """Have a job run on a thread of its own."""

        def repeat() -> None:
            while not self._closing.wait(period):
                _run(job)

        thread = threading.Thread(target=repeat, name="periodic", daemon=True)
        self._periodic.append(thread)
        if self._thread.is_alive():
            thread.start()

    def executor(self, workers: int) -> Executor:
        """A pool of threads."""
        return ThreadPoolExecutor(workers, thread_name_prefix="answer")

    def catch_up(self) -> None:
        """Nothing: questions are answered from the last merged map, and merging goes on in parallel."""

    def give_way(self, busy: Callable[[], bool]) -> None:
        """The background's thread takes the interpreter from all others: it sleeps meanwhile."""
        self._busy = busy

    def pause(self) -> None:
        """Sleep as long as something more urgent goes on, up to `GIVEN_WAY`."""
        if self._closing.is_set() and threading.current_thread() is self._thread:
            raise _Ended
        end = time.monotonic() + GIVEN_WAY
        while self._busy() and time.monotonic() < end and not self._closing.is_set():
            time.sleep(GLANCE)

    def start(self) -> None:
        """Start the threads."""
        if not self._thread.is_alive() and not self._closing.is_set():
            self._thread.start()
            for thread in self._periodic:
                thread.start()

    def close(self) -> bool:
        """Drop what waits, interrupt what runs, and end."""
        self._closing.set()
        with self._changed:
            self._changed.notify()
        threads = [t for t in (self._thread, *self._periodic) if t is not threading.current_thread()]
        for thread in threads:
            if thread.is_alive():
                thread.join(ENDING)
        return not any(thread.is_alive() for thread in threads)

    def _work(self) -> None:
        try:
            while (step := self._next()) is not None:
                self.pause()
                _run(step)
        except _Ended:
            self._jobs.clear()

    def _next(self) -> Job | None:
        """The next thing to do, waited for; None at the end."""
        with self._changed:
            while True:
                now = time.monotonic()
                if self._idle_wanted:
                    quiet = not self._jobs and now >= self._quiet_at
                    if now >= self._rest_until and (quiet or now >= self._waiting_since + OVERDUE):
                        return self._idle_step
                if self._jobs:
                    if not self._idle_wanted:
                        self._idle_wanted, self._waiting_since = self._idle is not None, now
                    self._quiet_at = now + QUIET
                    return self._jobs.popleft()
                if self._closing.is_set():
                    return None
                due = max(self._rest_until, self._quiet_at)
                self._changed.wait(due - now if self._idle_wanted else None)

    def _idle_step(self) -> None:
        pause = None
        try:
            if self._idle is not None and not self._closing.is_set():
                pause = self._idle()
        finally:
            self._idle_wanted = pause is not None
            self._rest_until = self._waiting_since = time.monotonic() + (pause or 0.0)


class _Inline(Executor):
    """Does the work in the thread that asks, one question after the other."""

    def __init__(self, turn: threading.RLock, catch_up: Job) -> None:
        self._turn, self._catch_up = turn, catch_up

    def submit(self, work: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        future: Future[_T] = Future()
        with self._turn:
            self._catch_up()
            try:
                future.set_result(work(*args, **kwargs))
            except Exception as error:  # noqa: BLE001 - raised where the result is read, as with a worker
                future.set_exception(error)
        return future


class LockstepSchedule:
    """Without threads: jobs run when a question is asked, and the clock is that of the robots' messages.

    What a server answers then depends on what it was sent before, and not on how quick the machine is.
    """

    def __init__(self) -> None:
        self._turn = threading.RLock()
        self._inbox: deque[Job] = deque()
        self._idle: IdleJob | None = None
        self._periodic: list[_Periodic] = []
        self._stamp_ns = 0

    def monotonic(self) -> float:
        """The newest stamp of a robot, s."""
        return self._stamp_ns * 1e-9

    def time_ns(self) -> int:
        """The newest stamp of a robot, ns."""
        return self._stamp_ns

    def observe(self, stamp_ns: int) -> None:
        """Let time pass up to a robot's stamp."""
        with self._turn:
            self._stamp_ns = max(self._stamp_ns, stamp_ns)

    def post(self, job: Job) -> None:
        """Run a job at the next catch-up."""
        self._inbox.append(job)

    def idle(self, job: IdleJob) -> None:
        """Have one job run at the end of catching up, until it has nothing left to do."""
        self._idle = job

    def every(self, period: float, job: Job) -> None:
        """Run a job at a catch-up after so much simulated time has passed."""
        self._periodic.append(_Periodic(period, job, self.monotonic() + period))

    def executor(self, workers: int) -> Executor:
        """Answers in the thread that asks, after catching up."""
        return _Inline(self._turn, self.catch_up)

    def catch_up(self) -> None:
        """Do all that was posted, then what is idle work, then what is due by the clock."""
        with self._turn:
            while True:
                while self._inbox:
                    _run(self._inbox.popleft())
                if (self._idle is None or self._idle() is None) and not self._inbox:
                    break
            for job in self._periodic:
                if job.due <= self.monotonic():
                    job.due = self.monotonic() + job.period
                    _run(job.job)

    def give_way(self, busy: Callable[[], bool]) -> None:
        """Nothing: work runs when it is its turn."""

    def pause(self) -> None:
        """Nothing, likewise."""

    def start(self) -> None:
        """Nothing: work runs with the next question."""

    def close(self) -> bool:
        """Do what was posted."""
        self.catch_up()
        return True


@dataclass
class _Periodic:
    period: float
    job: Job
    due: float
