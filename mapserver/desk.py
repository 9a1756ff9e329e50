"""Workers for questions that take long. Whoever would wait too long is told at once when to come again."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

from hybridmap.errors import Busy, SettingsError

_T = TypeVar("_T")


@dataclass(frozen=True)
class DeskSettings:
    """How questions are shared out.

    Attributes:
        workers: threads; 0: whoever asks does the work itself, one after the other and without a limit.
        in_time: a question that would have its answer later than this, as far as is known, is refused, unless
            a worker is free, s.
        too_late: one whose turn comes so late that its answer would take so many times as long is refused
            as well: the others behind it are answered in time then.
        first_guess: how long a question takes, before any was answered, s.
        smoothing: weight of the newest question in the mean time that one takes.
        longest_pause: nobody is sent away for longer, s.
    """

    workers: int = min(os.cpu_count() or 1, 4)
    in_time: float = 0.7
    too_late: float = 1.25
    first_guess: float = 0.1
    smoothing: float = 0.2
    longest_pause: float = 10.0

    def __post_init__(self) -> None:
        """Refuse what cannot work.

        Raises:
            SettingsError: a number out of range.
        """
        if not 0 <= self.workers <= 64:
            raise SettingsError(f"desk: {self.workers} workers; use 0 to 64")
        if not (self.in_time > 0.0 and self.first_guess > 0.0 and self.longest_pause > 0.0):
            raise SettingsError("desk: in_time, first_guess and longest_pause must be positive")
        if not self.too_late >= 1.0:
            raise SettingsError(f"desk: too_late {self.too_late:g} must be 1 or more")
        if not 0.0 < self.smoothing <= 1.0:
            raise SettingsError(f"desk: smoothing {self.smoothing:g} must be above 0 and at most 1")


class Desk:
    """A pool of workers with a queue that is never longer than can be worked off in time.

    Those who are refused get appointments one after the other, so that a crowd does not come back as a crowd.
    """

    def __init__(
        self, settings: DeskSettings | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start the workers.

        Args:
            settings: how many, and what is too long.
            clock: tells the time, s.
        """
        self._settings = settings or DeskSettings()
        self._clock = clock
        self._lock = threading.Lock()
        self._open = 0
        self._answered = 0
        self._refused = 0
        self._seconds = self._settings.first_guess
        self._appointment = -math.inf
        workers = self._settings.workers
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="desk") if workers else None

    def submit(self, work: Callable[[], _T]) -> Future[_T]:
        """Have something done.

        Returns:
            Its result, or what it raised, some time later; Busy if it has waited too long.

        Raises:
            Busy: it would wait too long; nothing was done.
        """
        if self._pool is None:
            done: Future[_T] = Future()
            try:
                done.set_result(self._timed(work))
            except Exception as error:  # noqa: BLE001 - goes to whoever asks for the result, as a worker's does
                done.set_exception(error)
            return done
        with self._lock:
            wait = self._wait()
            if wait > 0.0 and wait + self._seconds > self._settings.in_time:
                self._refused += 1
                raise Busy(self._next_appointment(wait))
            self._open += 1
            latest = self._clock() + self._settings.too_late * self._settings.in_time
        return self._pool.submit(self._unless_late, work, latest if wait > 0.0 else math.inf)

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
        """Finish what was taken on. Twice is no error."""
        if self._pool is not None:
            self._pool.shutdown()

    def _wait(self) -> float:
        """How long a question that comes now would wait for a worker, s."""
        workers = self._settings.workers
        return max(self._open - workers + 1, 0) * self._seconds / workers

    def _next_appointment(self, wait: float) -> float:
        """In how many seconds somebody may come again: when the queue is half empty, behind all others."""
        s, now = self._settings, self._clock()
        first = now + max(wait - 0.5 * s.in_time, 0.0)
        self._appointment = max(self._appointment, first) + self._seconds / s.workers
        self._appointment = min(self._appointment, now + s.longest_pause)
        return self._appointment - now

    def _unless_late(self, work: Callable[[], _T], latest: float) -> _T:
        """What a worker does with a question when its turn has come."""
        with self._lock:
            if self._clock() + self._seconds > latest:
                self._open -= 1
                self._refused += 1
                raise Busy(self._next_appointment(self._wait()))
        return self._timed(work)

    def _timed(self, work: Callable[[], _T]) -> _T:
        began = self._clock()
        try:
            return work()
        finally:
            with self._lock:
                self._open -= self._pool is not None
                self._answered += 1
                self._seconds += self._settings.smoothing * (self._clock() - began - self._seconds)
