"""One worker thread a bus, on which all of its handlers run, one after the other.

Transports must never wait for a handler: Zenoh stalls a whole session when a callback falls behind. So a
callback only puts a task into this queue. The queue is bounded, and nothing is dropped silently: a message
that finds it full is counted and logged (replication repairs it), a question is refused so that its asker
knows, and liveliness news always find room, because they are not repeated. Robots take turns (`FairQueue`):
one that floods a server waits for itself.
"""

import logging
import threading
import time
from collections.abc import Callable

from mapweave.hybridmap.errors import Busy, MapweaveError
from mapweave.wire.bus import Request, Sample
from mapweave.wire.fair_queue import FairQueue
from mapweave.wire.keys import robot_of

log = logging.getLogger(__name__)

DEFAULT_LIMIT = 16384
"""Tasks that may wait: half a minute of a hundred robots at five messages a second."""
MOST_BYTES = 2**26
"""Of messages and questions that may wait: as many changes of 4 kB."""
EVERY = 60.0
"""s within which one failed message of a robot is logged: a flood must not become a flood of log lines."""
MOST_ROBOTS = 4096
"""Whose failures are counted; one more forgets that of the longest ago."""
FULL_PAUSE = 1.0
"""After what time a question that found the queue full may be asked again, s."""


class Dispatcher:
    """Runs handlers in order on a thread of its own.

    Attributes:
        lost: messages that found the queue full.
        refused: questions that found the queue full.
    """

    def __init__(self, name: str, limit: int = DEFAULT_LIMIT) -> None:
        """Start the thread.

        Args:
            name: of the thread, for people who debug.
            limit: tasks that may wait.
        """
        self.lost = 0
        self.refused = 0
        self._tasks: FairQueue[Callable[[], None]] = FairQueue(limit, MOST_BYTES)
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def message(self, handler: Callable[[Sample], None], sample: Sample, wanted: Callable[[], bool]) -> None:
        """Hand over a message, unless its subscription has ended when its turn comes."""

        def task() -> None:
            if wanted():
                guarded(lambda: handler(sample), sample.key)

        if not self._put(task, sample.key, len(sample.payload)):
            self.lost += 1
            # Each power of two: a flood must not become a flood of log lines.
            if self.lost & (self.lost - 1) == 0:
                log.warning("slow handlers: %d messages lost so far, last on %s", self.lost, sample.key)

    def question(
        self, handler: Callable[[Request], None], request: Request, wanted: Callable[[], bool]
    ) -> None:
        """Hand over a question; a handler that raises refuses it."""

        def task() -> None:
            if not wanted():
                request.refuse("no longer served")
                return
            try:
                handler(request)
            except Busy as error:
                request.refuse(str(error), error.retry_after)
            except MapweaveError as error:
                request.refuse(str(error))
            except Exception as error:
                if (also := failures.count(request.key)) is not None:
                    log.exception("a handler of %s failed%s", request.key, also)
                request.refuse(f"internal error: {type(error).__name__}")

        if not self._put(task, request.key, len(request.payload)):
            self.refused += 1
            if self.refused & (self.refused - 1) == 0:
                log.warning("slow handlers: %d questions refused so far", self.refused)
            busy = Busy(FULL_PAUSE)
            request.refuse(str(busy), busy.retry_after)

    def presence(self, report: Callable[[], None], key: str) -> None:
        """Hand over that liveliness has changed; see mapweave.wire.alive_keys, which does so rarely."""
        self._put(report, key, bounded=False)

    @property
    def dropped(self) -> int:
        """Messages and questions that found the queue full."""
        return self.lost + self.refused

    def close(self) -> None:
        """Finish the running handler, forget what waits. Twice is no error.

        A handler must not close its own bus; if it does so all the same, it is not waited for.
        """
        with self._changed:
            self._closed = True
            self._tasks.clear()
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _put(self, task: Callable[[], None], key: str, size: int = 0, *, bounded: bool = True) -> bool:
        with self._changed:
            if self._closed:
                return True
            if not self._tasks.put(robot_of(key), task, size, bounded=bounded):
                return False
            self._changed.notify()
            return True

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._tasks and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                _, task = self._tasks.pop()
            task()


def guarded(call: Callable[[], None], key: str) -> None:
    """Run a handler whose caller is far away: its failure ends here, in the log, once."""
    try:
        call()
    except MapweaveError as error:
        if (also := failures.count(key)) is not None:
            log.warning("%s: %s%s", key, error, also)
    except Exception:
        if (also := failures.count(key)) is not None:
            log.exception("a handler of %s failed%s", key, also)


class Failures:
    """Messages with which a handler failed: one a minute of each robot is logged. Thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Take a clock that only grows, s."""
        self._clock, self._lock = clock, threading.Lock()
        self._since: dict[str, tuple[float, int]] = {}

    def count(self, key: str) -> str | None:
        """Count one by the key of the message or question; see `count_of`."""
        return self.count_of(robot_of(key))

    def count_of(self, robot: str) -> str | None:
        """Count one.

        Args:
            robot: in whose name it is; of what is in no robot's name each one is logged.

        Returns:
            How many were not logged since the last one that was, in words; None if this one is not to be.
        """
        now = self._clock()
        if not robot:
            return ""
        with self._lock:
            since, more = self._since.pop(robot, (now - EVERY, 0))
            due = now - since >= EVERY
            self._since[robot] = (now, 0) if due else (since, more + 1)
            if len(self._since) > MOST_ROBOTS:
                del self._since[next(iter(self._since))]
        if not due:
            return None
        return f" ({more} more of {robot} within {now - since:.0f} s)" if more else ""


failures = Failures()
