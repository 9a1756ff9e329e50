"""What a viewer sends: it has nothing to say, and cannot make it long."""

import asyncio
import tracemalloc
import zlib
from typing import Any

import pytest
import uvicorn
from uvicorn.server import ServerState

from mapweave.mapserver.http.serving import MAX_VIEWER_BYTES
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.http.websocket import WebSocketConnection
from tests.mapserver.http.client import raw
from tests.waiting import eventually

HEAD = (
    b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    b"Sec-WebSocket-Extensions: permessage-deflate\r\n\r\n"
)
CHUNK = 256 * 1024
"""Bytes that asyncio reads at once."""


class Transport(asyncio.Transport):
    """Keeps what is sent."""

    def __init__(self) -> None:
        super().__init__()
        self.sent, self.closed = b"", False

    def write(self, data: Any) -> None:
        self.sent += bytes(data)

    def pause_reading(self) -> None:
        pass

    def is_closing(self) -> bool:
        return self.closed

    def close(self) -> None:
        self.closed = True


def compressed_zeros(length: int) -> bytes:
    """A frame of at most `length` bytes that is a thousand times as long, with a mask of zero."""
    payload = zlib.compress(bytes(1000 * length), 9, wbits=-15)[:length]
    return b"\xc2\xff" + len(payload).to_bytes(8, "big") + bytes(4) + payload


def sent_after(frames: bytes) -> tuple[bytes, int, list[Any]]:
    """What a server sends on these frames, the memory that they took, and the messages that came."""
    came: list[Any] = []

    async def application(scope: Any, receive: Any, send: Any) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        while (message := await receive())["type"] != "websocket.disconnect":
            came.append(message)

    async def converse() -> tuple[bytes, int]:
        config = uvicorn.Config(
            application, interface="asgi3", lifespan="off", log_config=None, ws_max_size=MAX_VIEWER_BYTES
        )
        config.load()
        transport, state = Transport(), ServerState()
        viewer = WebSocketConnection(config, state, {}, asyncio.get_running_loop())
        viewer.connection_made(transport)
        viewer.data_received(HEAD)
        for _ in range(5):
            await asyncio.sleep(0)
        assert b"101" in transport.sent and b"permessage-deflate" in transport.sent
        transport.sent = b""
        tracemalloc.start()
        viewer.data_received(frames)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        viewer.connection_lost(None)
        await asyncio.gather(*state.tasks)
        return transport.sent, peak

    return (*asyncio.run(converse()), came)


def test_a_compressed_message_takes_no_memory():
    """Before, 256 kB took 256 MB and more before they were found too long."""
    sent, peak, came = sent_after(compressed_zeros(CHUNK))
    assert peak < 8_000_000 and not came
    assert b"exceeds the maximum size" in sent


def test_a_short_message_comes_as_it_was():
    """Also one in two frames, of which the server reads more than one piece."""
    text = bytes([1]) + bytes([0x80 | 126]) + (600).to_bytes(2, "big") + bytes(4) + b"a" * 600
    text += bytes([0x80]) + bytes([0x80 | 126]) + (400).to_bytes(2, "big") + bytes(4) + b"b" * 400
    _, _, came = sent_after(text)
    assert [message["text"] for message in came] == ["a" * 600 + "b" * 400]


@pytest.mark.parametrize("header", [b"Sec-WebSocket-Extensions: \x84", b"Sec-WebSocket-Protocol: \xe9"])
def test_a_head_that_cannot_be_read_is_refused_and_leaves_nothing(served: Web, header: bytes):
    """Before, each was counted as a connection for ever: a thousand of them, and no page came any more."""
    head = HEAD.removesuffix(b"\r\n") + header + b"\r\n\r\n"
    eventually(lambda: served.connections == 0)
    got = raw(served, head)
    assert got.startswith(b"HTTP/1.1 400 ") and b"nosniff" in got
    eventually(lambda: served.connections == 0)
