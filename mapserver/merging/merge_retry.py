"""When merging is tried again that has ended for want of memory: in this process, or with it."""

import gc
import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

log = logging.getLogger(__name__)

SUFFIX = ".merging"
"""Of the file, behind the store's name, that is there while something is merged."""
FIRST, LONGEST = 10.0, 600.0
"""s until it is tried again; each time twice as many, up to the longest."""
SHORT = "merging needs more memory than there is"


class MergeRetry:
    """Only the merging thread may call it, but for `pause`.

    Attributes:
        words: why something is not merged before `pause` has passed, in one line.
    """

    def __init__(self, path: Path | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        """Look whether the last process ended while it merged.

        After the first such end merging begins at once, since a person may have killed the process. After a
        second one in a row it waits: meanwhile questions are answered from each map by itself.

        Args:
            path: of the store's file; None: the end of a process is not noticed.
            clock: the time, s.
        """
        self._clock = clock
        self._path = None if path is None else path.with_name(path.name + SUFFIX)
        self._ends = self._failures = 0
        self._first = False
        self._wait_until, self.words = -math.inf, ""
        with suppress(OSError, ValueError):
            if self._path is not None:
                self._ends = int(self._path.read_text(encoding="ascii"))
        if self._ends:
            times = "" if self._ends == 1 else f" {self._ends} times in a row"
            words = f"the process ended before it had merged{times}, as where the memory does not suffice"
            self._wait(words, self._ends - 1)
            log.warning("%s", self.words)

    @property
    def pause(self) -> float:
        """How long nothing shall be merged yet, s. From any thread."""
        return max(self._wait_until - self._clock(), 0.0)

    def begin(self) -> None:
        """All is read: take note of an end of the process before it is merged, or `end` is called."""
        self._first = True
        self._mark()

    def end(self) -> None:
        """It is merged, or cannot be, or need not be: an end of the process means nothing now."""
        self._first = False
        self._clear()

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """Around what may need much memory: takes note of an end of the process meanwhile."""
        self._mark()
        try:
            yield
        finally:
            if not self._first:
                self._clear()

    def succeeded(self, whole: bool = True) -> None:
        """Something was merged.

        Args:
            whole: all that was read; else less, as the constraints before there is a map.
        """
        self._failures = 0
        if whole:
            self._ends = 0
            self.end()

    def short(self) -> None:
        """There was not enough memory: free what can be, and wait."""
        gc.collect()
        self.end()
        self._failures += 1
        self._wait(SHORT, self._failures)
        log.error("%s; answers are from the last merged map", self.words)

    def _wait(self, words: str, times: int) -> None:
        """Wait for twice as long each time."""
        pause = min(FIRST * 2.0 ** (times - 1), LONGEST) if times else 0.0
        self._wait_until = self._clock() + pause
        self.words = f"{words}: merging begins again after {pause:.0f} s" if times else words

    def _mark(self) -> None:
        with suppress(OSError):
            if self._path is not None:
                self._path.write_text(str(self._ends + 1), encoding="ascii")

    def _clear(self) -> None:
        with suppress(OSError):
            if self._path is not None:
                self._path.unlink(missing_ok=True)
