"""The time by which drivers stamp: nanoseconds since 1970 as at the start, and never a step back."""

from __future__ import annotations

import time

_EPOCH_NS = time.time_ns() - time.monotonic_ns()
"""When the monotonic clock was zero. Looked up once: setting the system's clock later moves no stamp."""


def now_ns() -> int:
    """Now."""
    return _EPOCH_NS + time.monotonic_ns()


def of_monotonic_ns(monotonic_ns: int) -> int:
    """The stamp of a reading of the system's monotonic clock."""
    return _EPOCH_NS + monotonic_ns
