"""Ctrl-C before a command has signal handlers of its own.

Python raises KeyboardInterrupt wherever the program is. Within the import of a library in C that may be
swallowed: the simulator then went on as if nothing had come.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType

_came = False


def remember() -> None:
    """From now on it is remembered that Ctrl-C came; KeyboardInterrupt is raised as before."""
    global _came
    _came = False
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def came() -> bool:
    """Whether Ctrl-C has come since."""
    return _came


def _interrupt(signum: int, frame: FrameType | None) -> None:
    global _came
    _came = True
    signal.default_int_handler(signum, frame)
