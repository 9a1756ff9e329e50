"""A lock that many may share who only read, and that one has alone who writes."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class SharedLock:
    """Readers share it. Who waits to write goes before those who come to read later.

    Who holds it may take it again: a writer to write or to read, a reader to read.
    """

    def __init__(self) -> None:
        """It is free."""
        self._changed = threading.Condition()
        self._readers = self._waiting = self._writer = 0
        self._held = threading.local()

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Share it with others who read."""
        depth = getattr(self._held, "depth", 0)
        if not depth:
            with self._changed:
                self._changed.wait_for(lambda: not self._writer and not self._waiting)
                self._readers += 1
        self._held.depth = depth + 1
        try:
            yield
        finally:
            self._held.depth = depth
            if not depth:
                with self._changed:
                    self._readers -= 1
                    self._changed.notify_all()

    @contextmanager
    def writing(self, wait: bool = True) -> Iterator[bool]:
        """Have it alone.

        Args:
            wait: for others; without, it is not taken if any holds it.

        Yields:
            Whether it is held.

        Raises:
            RuntimeError: who holds it to read cannot have it alone.
        """
        me, depth = threading.get_ident(), getattr(self._held, "depth", 0)
        if depth and self._writer != me:
            if wait:
                raise RuntimeError("a reader would wait for itself")
            yield False
            return
        if not depth and not self._taken(me, wait):
            yield False
            return
        self._held.depth = depth + 1
        try:
            yield True
        finally:
            self._held.depth = depth
            if not depth:
                with self._changed:
                    self._writer = 0
                    self._changed.notify_all()

    def _taken(self, me: int, wait: bool) -> bool:
        with self._changed:
            if not wait and (self._writer or self._readers or self._waiting):
                return False
            self._waiting += 1
            try:
                self._changed.wait_for(lambda: not self._writer and not self._readers)
            finally:
                self._waiting -= 1
            self._writer = me
            return True
