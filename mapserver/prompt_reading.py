"""What is read again each time it is asked for, and holds up no caller for long."""

from collections.abc import Callable
from concurrent.futures import Executor
from typing import Generic, TypeVar

from mapweave.hybridmap.errors import InvalidFile

T = TypeVar("T")
PATIENCE = 0.3
"""Longest wait, s: who asks for a server's status is answered by the thread that also takes the questions of
lost robots, and these wait a second at most."""
LONG = 5.0
"""A reading that takes longer is named, s: as a commit that waits."""
SILENT = "the store does not answer"


class PromptReading(Generic[T]):
    """Reads a store that may wait for a disk or for a database that does not answer."""

    def __init__(self, read: Callable[[], T], executor: Executor, clock: Callable[[], float]) -> None:
        """Read for the first time, however long it takes.

        Args:
            read: what to read; raises InvalidFile if that is not possible.
            executor: reads, with one worker.
            clock: s.

        Raises:
            InvalidFile: it cannot be read.
        """
        self._read, self._executor, self._clock = read, executor, clock
        self._value = read()
        self._since: float | None = None

    def newest(self) -> tuple[T, str]:
        """What is read now or was read last, and why it is not of now; from any thread."""
        since = self._since
        if since is None or self._clock() < since + PATIENCE:
            try:
                return self._executor.submit(self._read_again).result(PATIENCE), ""
            except InvalidFile as error:
                return self._value, str(error)
            except TimeoutError:
                pass
        return self._value, SILENT if since is not None and self._clock() > since + LONG else ""

    def _read_again(self) -> T:
        self._since = self._clock()
        try:
            self._value = self._read()
            return self._value
        finally:
            self._since = None
