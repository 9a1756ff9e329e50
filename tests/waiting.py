"""Waiting for what other threads and processes do; and a port to do it at."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

PATIENCE = 30.0
"""s; it costs nothing where all goes well, and a machine may be busy with other things."""


def eventually(condition: Callable[[], object], seconds: float = PATIENCE) -> None:
    """Return as soon as a condition holds; fail if it does not within this time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"did not happen in {seconds:.0f} s"
        time.sleep(0.005)


def free_port() -> int:
    """A free port of loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
