"""The map server's HTTP application without sockets: requests by ASGI, as the web server hands them over."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mapweave.mapserver.http.rates import Rates
from mapweave.mapserver.http.same_site import SameSite
from mapweave.mapserver.http.web import Questions
from mapweave.mapserver.schedule import LockstepSchedule
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub


class HttpApplication:
    """Of a server without maps."""

    def __init__(self) -> None:
        """Start it."""
        folder = Path(tempfile.mkdtemp(prefix="fuzz-http-"))
        bus = MemoryBus(MemoryHub())
        server = MapServer(bus, Keys("demo"), folder / "s0.sqlite", "s0", schedule=LockstepSchedule())
        server.__enter__()
        self._app = SameSite(Questions(server, 2.0, rates=Rates(1e9)).app, "127.0.0.1")

    async def answer(self, data: bytes) -> int:
        """Ask, and return the status.

        Args:
            data: `METHOD path?query`, then behind a line feed the body.
        """
        line, _, body = data.partition(b"\n")
        # The web server refuses a request line of other characters by itself.
        line = bytes(byte for byte in line if 0x20 <= byte < 0x7F)
        method, _, target = line.partition(b" ")
        path, _, query = target.partition(b"?")
        status = 0

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body, "more_body": False}

        async def send(message: Any) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]

        text = path.decode("latin-1")
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
