"""A WebSocket with limits: a viewer that is gone or takes nothing is dropped."""

import asyncio
from typing import Any

from uvicorn.protocols.websockets.wsproto_impl import WSProtocol

PIECE = 1024
"""Bytes that are looked at before the longest message is compared; compressed they can be 1 MB."""


class WebSocketConnection(WSProtocol):
    """One viewer.

    Attributes:
        stall: s in which it may take nothing of what is sent.
    """

    stall = 10.0
    _stalled: asyncio.TimerHandle | None = None

    def __init__(self, *arguments: Any, **named: Any) -> None:
        """Begin."""
        super().__init__(*arguments, **named)
        # A handshake has a header Connection of its own.
        self.default_headers = [
            (name, value) for name, value in self.default_headers if name != b"connection"
        ]

    async def send(self, message: Any) -> None:
        """Send what the application says; also a refusal has the headers of every answer."""
        if message["type"] == "websocket.http.response.start":
            message = {**message, "headers": [*message["headers"], *self.default_headers]}
        await super().send(message)

    def data_received(self, data: bytes) -> None:
        """Take it in pieces: compressed, a message is a thousand times as long before it is refused."""
        for begin in range(0, len(data), PIECE):
            if self.transport.is_closing():
                return
            try:
                super().data_received(data[begin : begin + PIECE])
            except ValueError:
                # wsproto reads the lists in a head as ASCII. With the exception the connection would go to
                # asyncio, which drops it, and it would count as an open one for ever.
                self._refuse()

    def pause_writing(self) -> None:
        """The peer is slower than what is sent."""
        super().pause_writing()
        self._watch(self.transport.get_write_buffer_size())

    def resume_writing(self) -> None:
        """It has taken enough."""
        super().resume_writing()
        if self._stalled is not None:
            self._stalled.cancel()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clock."""
        if self._stalled is not None:
            self._stalled.cancel()
        super().connection_lost(exc)

    def _refuse(self) -> None:
        """Answer a head that cannot be read."""
        lines = [b"HTTP/1.1 400 Bad Request", b"connection: close", b"content-length: 0"]
        lines += [name + b": " + value for name, value in self.default_headers]
        self.transport.write(b"\r\n".join([*lines, b"", b""]))
        self.transport.close()

    def _watch(self, before: int) -> None:
        def check() -> None:
            left = self.transport.get_write_buffer_size()
            if left >= before:
                self.transport.abort()
            else:
                self._watch(left)

        self._stalled = self.loop.call_later(self.stall, check)
