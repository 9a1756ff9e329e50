"""What has come from robots and waits for the ingest's thread: robots take turns."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from mapweave.wire.fair_queue import FairQueue

_T = TypeVar("_T")

MOST = 4096
"""Published changes that wait; what finds no room is pulled later. Also at most as many bytes:"""
MOST_BYTES = 2**25
"""Of published changes; what finds no room is pulled later."""
LONGEST_WAIT = 3600.0
"""s, when nothing is due: an infinite one cannot be given."""


class Inbox(Generic[_T]):
    """Thread-safe."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._items: FairQueue[_T] = FairQueue(MOST, MOST_BYTES)
        self._woken = False

    def put(
        self,
        robot: str,
        item: _T,
        size: int = 0,
        *,
        bounded: bool = True,
        replaces: Callable[[_T], bool] | None = None,
    ) -> bool:
        """Add something of a robot, see FairQueue.put; False if there is no room for it."""
        with self._changed:
            taken = self._items.put(robot, item, size, bounded=bounded, replaces=replaces)
            self._changed.notify()
        return taken

    def __len__(self) -> int:
        with self._changed:
            return len(self._items)

    def interrupt(self) -> None:
        """End the wait."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    def take(self, most: int, timeout: float) -> list[tuple[str, list[_T]]]:
        """Wait for something; then so much at most, by robots: the one with the least comes first."""
        taken: dict[str, list[_T]] = {}
        with self._changed:
            self._changed.wait_for(lambda: len(self._items) or self._woken, min(timeout, LONGEST_WAIT))
            for _ in range(min(most, len(self._items))):
                robot, item = self._items.pop()
                taken.setdefault(robot, []).append(item)
        return sorted(taken.items(), key=lambda entry: len(entry[1]))
