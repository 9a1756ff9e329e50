"""Asking servers that may be busy."""

from __future__ import annotations

import time

from mapweave.wire.bus import Bus, Reply


def ask_patiently(bus: Bus, key: str, payload: bytes, timeout: float) -> list[Reply]:
    """Ask, and ask busy servers again at their time, until the patience is over.

    Args:
        bus: the connection.
        key: that is asked.
        payload: the question.
        timeout: longest wait for the answer, s.
    """
    end = time.monotonic() + timeout
    while True:
        replies = bus.ask(key, payload, max(end - time.monotonic(), 0.1))
        pause = max((reply.retry_after for reply in replies), default=0.0)
        if pause <= 0.0 or time.monotonic() + pause > end:
            return replies
        time.sleep(pause)
