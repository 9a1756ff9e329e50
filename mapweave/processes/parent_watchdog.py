"""A child process that stops when its parent is gone, however that ended.

The parent holds the writing end of a pipe that is the child's stdin, and never writes. When the parent ends,
killed or not, the system closes it, and the child reads the end of its stdin.
"""

import os
import threading
from collections.abc import Mapping

NAME = "MAPWEAVE_PARENT_WATCHDOG"
"""Set in the environment of a process with such a stdin; other processes ignore their stdin."""


def environment() -> Mapping[str, str]:
    """The environment of a child that is started with a pipe as its stdin."""
    return {**os.environ, NAME: "1"}


def hold(stop: threading.Event) -> None:
    """Set `stop` when the parent has ended; does nothing in a process not started as such a child."""
    if os.environ.get(NAME):
        threading.Thread(target=_wait, args=(stop,), name="parent watchdog", daemon=True).start()


def _wait(stop: threading.Event) -> None:
    # Not sys.stdin: Python cannot end while a thread waits in it.
    while os.read(0, 1024):
        pass
    stop.set()
