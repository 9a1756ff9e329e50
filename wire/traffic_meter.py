"""A bus that counts what goes through it."""

import threading
from collections.abc import Callable
from typing import Any

from mapweave.wire.bus import Bus, Closing, Reply, Request, Sample, never


class TrafficMeter:
    """Counts keys, payloads and attachments in both directions; what the transport adds is not counted."""

    def __init__(self, bus: Bus) -> None:
        """Count from zero what goes over a bus. Closing this closes the bus."""
        self._bus = bus
        self._lock = threading.Lock()
        self._traffic = 0

    @property
    def traffic(self) -> int:
        """Bytes sent and received so far."""
        with self._lock:
            return self._traffic

    def _count(self, *parts: str | bytes) -> None:
        with self._lock:
            self._traffic += sum(map(len, parts))

    def publish(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        """Send; counted only while there is a connection."""
        if self._bus.connected():
            self._count(key, payload, attachment)
        self._bus.publish(key, payload, attachment)

    def subscribe(self, pattern: str, handler: Callable[[Sample], None], *, direct: bool = False) -> Closing:
        """Listen."""

        def count(sample: Sample) -> None:
            self._count(sample.key, sample.payload, sample.attachment)
            handler(sample)

        return self._bus.subscribe(pattern, count, direct=direct)

    def serve(self, key: str, handler: Callable[[Request], None]) -> Closing:
        """Answer questions."""

        def count(request: Request) -> None:
            self._count(request.key, request.payload)
            handler(_MeteredRequest(request, self._count))

        return self._bus.serve(key, count)

    def ask(
        self, key: str, payload: bytes, timeout: float, enough: Callable[[Reply], bool] = never
    ) -> list[Reply]:
        """Ask."""
        if self._bus.connected():
            self._count(key, payload)
        replies = self._bus.ask(key, payload, timeout, enough)
        for reply in replies:
            self._count(reply.payload, reply.error)
        return replies

    def __getattr__(self, name: str) -> Any:
        """All else is the bus's: the transport's own messages are not counted."""
        return getattr(self._bus, name)


class _MeteredRequest:
    def __init__(self, request: Request, count: Callable[..., None]) -> None:
        self._request = request
        self._count = count

    def reply(self, payload: bytes) -> None:
        self._count(payload)
        self._request.reply(payload)

    def refuse(self, reason: str, retry_after: float = 0.0) -> None:
        self._count(reason)
        self._request.refuse(reason, retry_after)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._request, name)
