"""The map server's HTTP application without sockets: requests by ASGI, as the web server hands them over."""

import asyncio
import tempfile
from pathlib import Path
from typing import Any
from urllib.parse import quote

import uvicorn
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.server import ServerState

from mapweave.mapserver.http.rates import Rates
from mapweave.mapserver.http.same_site import SameSite
from mapweave.mapserver.http.serving import MAX_VIEWER_BYTES
from mapweave.mapserver.http.web import Questions
from mapweave.mapserver.http.websocket import WebSocketConnection
from mapweave.mapserver.merging.merge_surroundings import MergeSurroundings
from mapweave.mapserver.schedule import LockstepSchedule
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub

TURNS = 5
"""Of the event loop, in which a viewer is let in."""


class HttpApplication:
    """The HTTP application of a server without maps."""

    def __init__(self) -> None:
        """Start it."""
        self._folder = tempfile.TemporaryDirectory(prefix="fuzz-http-")
        bus = MemoryBus(MemoryHub())
        server = MapServer(
            bus, Keys("demo"), Path(self._folder.name) / "s0.sqlite", "s0", schedule=LockstepSchedule(),
            surroundings=MergeSurroundings.repeatable,
        )  # fmt: skip
        self._server = server.__enter__()
        self._app = SameSite(Questions(server, 2.0, rates=Rates(1e9)).app, "127.0.0.1")
        self._failed: Exception | None = None
        self._config = uvicorn.Config(
            self._viewed, interface="asgi3", lifespan="off", log_config=None, ws_max_size=MAX_VIEWER_BYTES
        )
        self._config.load()
        # What the live view has begun goes on from one viewer to the next.
        self._runner = asyncio.Runner()

    def close(self) -> None:
        """End it."""
        self._runner.close()
        self._server.__exit__(None, None, None)
        self._folder.cleanup()

    def answer(self, data: bytes) -> int:
        """Ask, and return the status.

        Args:
            data: `METHOD path?query`, or `METHOD path?query content/type; options`; then behind a line feed
                the body.
        """
        return self._runner.run(self._answer(data))

    def watch(self, data: bytes) -> None:
        """Look at the live view by a WebSocket, and go again.

        Args:
            data: what a browser sends: the head of its request, then frames.
        """
        self._runner.run(self._watch(data))

    async def _answer(self, data: bytes) -> int:
        line, _, body = data.partition(b"\n")
        method, _, target = _printable(line).partition(b" ")
        target, _, kind = target.partition(b" ")
        path, _, query = target.partition(b"?")
        status = 0

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body, "more_body": False}

        async def send(message: Any) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]

        text = path.decode("latin-1")
        if not kind:
            kind = b"application/json" if text in ("/constraints", "/annotations", "/login") else b"image/png"
        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1",
            "method": method.decode("latin-1").upper(), "scheme": "http", "path": text,
            "raw_path": quote(text).encode(), "query_string": query, "root_path": "",
            "headers": [
                (b"host", b"127.0.0.1"), (b"content-length", b"%d" % len(body)), (b"content-type", kind),
            ],
            "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 80),
        }  # fmt: skip
        await self._app(scope, receive, send)
        return status

    async def _watch(self, data: bytes) -> None:
        transport, state = Transport(), ServerState()
        viewer = WebSocketConnection(self._config, state, {}, asyncio.get_running_loop())
        viewer.connection_made(transport)
        head, end, frames = data.partition(b"\r\n\r\n")
        for piece in (head + end, frames):
            viewer.data_received(piece)
            for _ in range(TURNS):
                await asyncio.sleep(0)
        viewer.connection_lost(None)
        for task in list(state.tasks):
            await task
        if self._failed is not None:
            failed, self._failed = self._failed, None
            raise failed

    async def _viewed(self, scope: Any, receive: Any, send: Any) -> None:
        """The application; what it fails with is kept, since the web server only logs it."""
        try:
            await self._app(scope, receive, send)
        except ClientDisconnected:
            raise
        except Exception as error:
            self._failed = error
            raise


class Transport(asyncio.Transport):
    """Takes everything and sends nothing."""

    def __init__(self) -> None:
        super().__init__()
        self._closing = False

    def write(self, data: Any) -> None:
        """Drop it."""

    def pause_reading(self) -> None:
        """There is nothing more to read."""

    def resume_reading(self) -> None:
        """Neither."""

    def is_closing(self) -> bool:
        return self._closing

    def close(self) -> None:
        self._closing = True


def _printable(line: bytes) -> bytes:
    """The web server refuses a request line and headers of other characters by itself."""
    return bytes(byte for byte in line if 0x20 <= byte < 0x7F)
