"""Closes at the interpreter's exit what its owner forgot to close."""

import threading

from mapweave.wire.bus import Closing

THREAD = "close-at-exit"
_lock = threading.Lock()
_open: dict[Closing, None] = {}
"""The oldest first."""


def remember(closing: Closing) -> None:
    """Close this at the exit, unless it is closed or gone by then."""
    with _lock:
        if not any(thread.name == THREAD for thread in threading.enumerate()):
            threading.Thread(target=_close_at_exit, name=THREAD, daemon=False).start()
        _open[closing] = None


def forget(closing: Closing) -> None:
    """It was closed."""
    _open.pop(closing, None)


def _close_at_exit() -> None:
    """Wait for the main thread's end, then close.

    An open Zenoh session keeps threads that the interpreter waits for before it calls anything registered
    with atexit, so that would be too late. And this thread is no daemon, because the interpreter must not end
    in the middle of closing.
    """
    threading.main_thread().join()
    # The newest first: clients of a router of this process take back declarations while it still routes.
    # In another order Zenoh 1.x may panic in a thread of the router, now and then.
    for closing in reversed(list(_open)):
        closing.close()
