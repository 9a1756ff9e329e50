"""Waiting for what other threads and processes do; and a port to do it at."""

import socket
import time
from collections.abc import Callable

PATIENCE = 30.0
"""s; it costs nothing where all goes well, and a machine may be busy with other things."""


def eventually(condition: Callable[[], object], seconds: float = PATIENCE) -> None:
    """Return as soon as a condition holds; fail if it does not within this time.

    A condition that takes long is evaluated less often: what it waits for needs the processor, too.
    """
    end = time.monotonic() + seconds
    while True:
        began = time.monotonic()
        if condition():
            return
        now = time.monotonic()
        assert now < end, f"did not happen in {seconds:.0f} s"
        time.sleep(min(max(0.01, 3 * (now - began)), 0.1))


def free_port() -> int:
    """A free port of loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
