"""Tells the fleet that a robot's base reports nothing, while the loop waits for its next observation."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SILENT = 2.0
"""s without an observation after which the fleet is informed; drivers return within two ticks."""
EVERY = 1.0
"""s between two looks, and two statuses."""


@contextmanager
def watching(waiting: Callable[[], float], tell: Callable[[float], None]) -> Iterator[None]:
    """Look from a thread of its own, until the end of the block, how long the loop waits.

    Args:
        waiting: since when there is no observation, s; 0 while the loop works on one.
        tell: called with that as long as it is `SILENT` or more, s.
    """
    over = threading.Event()

    def watch() -> None:
        while not over.wait(EVERY):
            if (silent := waiting()) >= SILENT:
                tell(silent)

    thread = threading.Thread(target=watch, name="base watch", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
