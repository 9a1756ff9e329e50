"""Ctrl-C before a command has signal handlers of its own.

Python raises KeyboardInterrupt wherever the program is. Within the import of a library in C that may be
swallowed: the simulator then went on as if nothing had come. Within a callback of a weak reference, of which
every import has one, Python prints the exception and goes on.
"""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

AGAIN = 0.02
"""s, after which an interrupt that was dropped comes again: what dropped it has ended by then."""

_came = False


def remember() -> None:
    """Remember from now on that Ctrl-C came; KeyboardInterrupt is raised as before."""
    global _came
    _came = False
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
        _raise_again_what_is_dropped()


def came() -> bool:
    """Whether Ctrl-C has come since."""
    return _came


def _interrupt(signum: int, frame: FrameType | None) -> None:
    global _came
    _came = True
    signal.default_int_handler(signum, frame)


def _raise_again_what_is_dropped() -> None:
    before, main = sys.unraisablehook, threading.get_ident()

    def hook(dropped: UnraisableHookArgs) -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            before(dropped)
            return
        # Not here: this is still within what drops it. To the main thread, whose system call it has to end.
        again = threading.Timer(AGAIN, signal.pthread_kill, (main, signal.SIGINT))
        again.daemon = True
        again.start()

    sys.unraisablehook = hook
