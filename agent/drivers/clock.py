"""Clock for stamps: nanoseconds since 1970, without steps when the system clock is set."""

from __future__ import annotations

import time

_EPOCH_NS = time.time_ns() - time.monotonic_ns()
"""System time at zero of the monotonic clock; read once, so that stamps never step."""


def now_ns() -> int:
    """The current time."""
    return _EPOCH_NS + time.monotonic_ns()


def of_monotonic_ns(monotonic_ns: int) -> int:
    """Stamp of a monotonic clock reading."""
    return _EPOCH_NS + monotonic_ns
