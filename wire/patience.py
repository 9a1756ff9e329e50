"""Asking servers that may be busy."""

import math
import threading
import time
from collections.abc import Callable

from mapweave.wire.bus import Bus, Reply

SHORTEST_PAUSE = 0.05
"""s between two of the same question, also where a server names less."""
MOST_OPEN = 8
"""Of the same question at once."""
MOST_REPLIES, MOST_BYTES = 1000, 2**25
"""To one question; more than any fleet's servers send. Then no more is waited for."""


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


class BusyServers:
    """One question to several servers, of which one may be busy while another says nothing.

    A server that is stopped, or behind a bad network, keeps the question open until its time is over. While
    it is waited for, a server that was busy is asked again at its time. One that lies about that, or replies
    without end, fills neither memory nor network.
    """

    def __init__(self, bus: Bus, key: str, payload: bytes, enough: Callable[[Reply], bool]) -> None:
        """Ask nothing yet.

        Args:
            bus: the connection.
            key: that is asked.
            payload: the question.
            enough: whether a reply ends the wait; called for one reply after the other.
        """
        self._bus, self._key, self._payload, self._enough = bus, key, payload, enough
        self._changed = threading.Condition()
        self._settled = False
        self._open = 0
        self._replies: list[Reply] = []
        self._bytes = 0
        self._again_at = math.inf

    def ask(self, timeout: float) -> list[Reply]:
        """Wait until a reply is enough, all servers have replied or the time is over.

        Args:
            timeout: s.

        Returns:
            All replies so far: of a busy server that, too.
        """
        end = time.monotonic() + timeout
        with self._changed:
            self._begin(timeout)
            while self._open and not self._settled:
                pause = self._again_at - time.monotonic()
                if pause > 0.0 or self._open == MOST_OPEN:
                    self._changed.wait(pause if pause > 0.0 and self._again_at < end else None)
                else:
                    self._again_at = math.inf
                    if (left := end - time.monotonic()) > 0.0:
                        self._begin(left)
            return list(self._replies)

    def _begin(self, timeout: float) -> None:
        self._open += 1
        threading.Thread(target=self._wait, args=(timeout,), name="question", daemon=True).start()

    def _wait(self, timeout: float) -> None:
        try:
            self._bus.ask(self._key, self._payload, timeout, self._take)
        finally:
            with self._changed:
                self._open -= 1
                self._changed.notify()

    def _take(self, reply: Reply) -> bool:
        with self._changed:
            if not self._settled:
                self._replies.append(reply)
                self._bytes += len(reply.payload)
                most = len(self._replies) >= MOST_REPLIES or self._bytes >= MOST_BYTES
                self._settled = self._enough(reply) or most
                if reply.retry_after > 0.0:
                    pause = max(reply.retry_after, SHORTEST_PAUSE)
                    self._again_at = min(self._again_at, time.monotonic() + pause)
                self._changed.notify()
            return self._settled
