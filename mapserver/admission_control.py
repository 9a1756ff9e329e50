"""Workers for long questions. A question that would wait too long is refused with a time to retry."""

import math
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, TypeVar

from msgspec import Meta

from mapweave.hybridmap.errors import Busy

TOO_LATE = 1.25
"""A question whose answer would take so many times `in_time` when its turn comes is refused then: the others
behind it are answered in time. Chosen: above 1, or what is accepted at the limit is refused after it has
waited."""
FIRST_GUESS = 0.1
"""How long a question is taken to take before any was answered, s. Chosen: several times what one takes (15
ms at 1000 places); it is forgotten after about 1 / SMOOTHING answers."""
SMOOTHING = 0.2
"""Weight of the newest question in the mean time that one takes: the mean is that of the last ten or so."""
LATENESS = 0.5
"""Tolerance of an appointment, s: a message takes time both ways."""
MOST_BOOKED = 1024
"""Retry appointments that are kept; beyond this number there is no precedence."""

_T = TypeVar("_T")


@dataclass(frozen=True)
class AdmissionSettings:
    """How a map server shares out the questions that take long.

    Attributes:
        workers: questions that are worked on at once; 0 for one a core, four at the most.
        in_time: a question that would have its answer later than this, as far as is known, is refused, unless
            a worker is free, s.
    """

    workers: Annotated[int, Meta(ge=0, le=64)] = 0
    in_time: Annotated[float, Meta(gt=0.0)] = 0.7

    @property
    def threads(self) -> int:
        """Workers on this machine."""
        return self.workers or min(os.cpu_count() or 1, 4)


SHORTEST_PAUSE = 0.1
"""Retry time of a robot whose last question is still open, s, at least."""
LONGEST_PAUSE = 10.0
"""Longest retry time, s."""


class AdmissionControl:
    """A pool of workers with a queue that is never longer than can be worked off in time.

    Refused questions get appointments one after the other, so that a crowd does not come back as a crowd.
    A question that comes back has precedence over new ones.
    """

    def __init__(
        self,
        settings: AdmissionSettings | None = None,
        clock: Callable[[], float] = time.monotonic,
        executor: Executor | None = None,
        first_guess: float = FIRST_GUESS,
    ) -> None:
        """Start the workers.

        Args:
            settings: how many, and what is too long.
            clock: the time, s.
            executor: does the work; threads of its own if not given. It is shut down with this.
            first_guess: how long a question takes, before any was answered, s.
        """
        self._settings = settings or AdmissionSettings()
        self._clock = clock
        self._lock = threading.Lock()
        self._open = 0
        self._answered = 0
        self._refused = 0
        self._seconds = first_guess
        self._appointment = -math.inf
        self._booked: dict[int, float] = {}
        self._asking: set[str] = set()
        workers = self._settings.threads
        self._pool = executor or ThreadPoolExecutor(workers, thread_name_prefix="admission")

    def submit(
        self, work: Callable[[], _T], ticket: int | None = None, usual: bool = True, asker: str = ""
    ) -> Future[_T]:
        """Submit a job.

        Args:
            work: to be done.
            ticket: the same when the same question comes again, and hardly ever that of another one; without
                one it never has precedence.
            usual: whether it takes as long as other questions do: else its duration is not recorded.
            asker: a robot, which asks one question after the other; empty for people.

        Returns:
            Its result, or what it raised, some time later; Busy if it has waited too long.

        Raises:
            Busy: it would wait too long, or the robot's last question is open; nothing was done.
        """
        with self._lock:
            if asker and asker in self._asking:
                # It gets no appointment: those are for robots that wait.
                self._refused += 1
                raise Busy(max(self._seconds, SHORTEST_PAUSE))
            s, now, wait = self._settings, self._clock(), self._wait()
            latest = TOO_LATE * s.in_time
            kept = self._keeps_appointment(ticket, now)
            allowed = latest if kept else s.in_time - self._expected(now)
            if wait > 0.0 and wait + self._seconds > allowed:
                self._refused += 1
                raise Busy(self._next_appointment(wait, ticket, kept))
            self._open += 1
            if asker:
                self._asking.add(asker)
        by = now + latest if wait > 0.0 else math.inf
        return self._pool.submit(self._unless_late, work, ticket, by, usual, asker)

    @property
    def busy(self) -> bool:
        """Whether a question is open."""
        return self._open > 0

    def counters(self) -> dict[str, int | float]:
        """Questions answered and refused so far, those open now, and how long one takes, ms."""
        with self._lock:
            return {
                "answered": self._answered,
                "busy": self._refused,
                "open": self._open,
                "answer_ms": round(1e3 * self._seconds, 1),
            }

    def close(self) -> None:
        """Finish accepted jobs. Idempotent."""
        self._pool.shutdown()

    def _wait(self) -> float:
        """How long a question that comes now would wait for a worker, s."""
        workers = self._settings.threads
        return max(self._open - workers + 1, 0) * self._seconds / workers

    def _keeps_appointment(self, ticket: int | None, now: float) -> bool:
        """Whether a ticket comes at its appointment, within `LATENESS`. A late one loses its precedence."""
        late = [one for one, due in self._booked.items() if due < now - LATENESS]
        for one in late:
            del self._booked[one]
        if ticket is None or self._booked.get(ticket, math.inf) > now + LATENESS:
            return False
        del self._booked[ticket]
        return True

    def _expected(self, now: float) -> float:
        """Time that appointments will take while a new question would wait, s."""
        soon = sum(due <= now + self._settings.in_time for due in self._booked.values())
        return soon * self._seconds / self._settings.threads

    def _next_appointment(self, wait: float, ticket: int | None, again: bool) -> float:
        """Seconds after which to retry: when the queue is half empty, after all others.

        A ticket that was refused at its appointment need not go to the end again.
        """
        s, now = self._settings, self._clock()
        due = now + max(wait - 0.5 * s.in_time, 0.0) + self._seconds / s.threads
        if not again:
            due = self._appointment = max(due, self._appointment + self._seconds / s.threads)
        due = min(due, now + LONGEST_PAUSE)
        self._appointment = min(self._appointment, now + LONGEST_PAUSE)
        if ticket is not None and len(self._booked) < MOST_BOOKED:
            self._booked[ticket] = due
        return due - now

    def _unless_late(
        self, work: Callable[[], _T], ticket: int | None, latest: float, usual: bool, asker: str
    ) -> _T:
        """What a worker does with a question when its turn has come."""
        with self._lock:
            if self._clock() + self._seconds > latest:
                self._open -= 1
                self._asking.discard(asker)
                self._refused += 1
                raise Busy(self._next_appointment(self._wait(), ticket, True))
        return self._timed(work, usual, asker)

    def _timed(self, work: Callable[[], _T], usual: bool, asker: str) -> _T:
        began = self._clock()
        try:
            return work()
        finally:
            with self._lock:
                self._open -= self._pool is not None
                self._asking.discard(asker)
                self._answered += 1
                if usual:
                    self._seconds += SMOOTHING * (self._clock() - began - self._seconds)
