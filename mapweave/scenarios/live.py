"""A trial to be watched while it runs: a page on this machine, for any browser. The page is in `static/`."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from mapweave.extras import how_to_install
from mapweave.hybridmap.errors import NotConnected, SettingsError
from mapweave.scenarios.film_frame import Frame

if TYPE_CHECKING:
    from starlette.types import ASGIApp

HOST = "127.0.0.1"
PORT = 8090
"""Chosen: beside the 8080 of servers."""
MOST_RATE = 20.0
"""Frames that a viewer gets in a wall second, at most: watching shall not slow the trial down."""
QUALITY = 80
"""Of the JPEG, percent."""
STUCK = 5.0
"""s; a viewer that takes nothing for this long is dropped."""
BOUNDARY = b"frame"
STATIC = Path(__file__).with_name("static")


class LiveFilm:
    """Shows the latest frame to any number of viewers; the trial never waits for them.

    Attributes:
        url: of the page.
    """

    def __init__(self, port: int = PORT, title: str = "Mapweave") -> None:
        """Begin to serve.

        Args:
            port: on this machine's loopback; 0 takes a free one.
            title: of the page.

        Raises:
            SettingsError: the port is in use, or may not be used, or what serves pages is not installed.
        """
        try:
            from mapweave.mapserver.http.same_site import SameSite
            from mapweave.mapserver.http.serving import ConnectionTimeouts, HttpThread
        except ModuleNotFoundError as error:
            raise SettingsError(
                f"the live view needs {error.name}: install the extra, {how_to_install('server')}"
            ) from None
        self._encoding = threading.Lock()
        self._latest: tuple[int, Frame] | None = None
        self._jpeg = (0, b"")
        self._closed = False
        try:
            app = SameSite(_application(self, title), HOST)
            self._http = HttpThread(app, (HOST, port), ConnectionTimeouts(whole=None, stall=STUCK), "live")
        except NotConnected as error:
            raise SettingsError(f"the live view cannot use port {port} ({error}); choose another") from None
        self.url = f"http://{HOST}:{self._http.port}/"

    def __enter__(self) -> LiveFilm:
        """Nothing more to do."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving."""
        self.close()

    def show(self, frame: Frame) -> None:
        """Replace what is shown, (H, W, 3) blue, green, red; it must not be changed afterwards."""
        self._latest = (1 if self._latest is None else self._latest[0] + 1, frame)

    def close(self) -> None:
        """Stop serving; every viewer's stream ends. Idempotent."""
        self._closed = True
        self._http.close()

    def latest(self) -> tuple[int, bytes]:
        """Number of the latest frame, 0 before the first, and its JPEG."""
        latest = self._latest
        if latest is None:
            return 0, b""
        number, frame = latest
        with self._encoding:
            # Another viewer may have asked for the same one.
            if self._jpeg[0] < number:
                encoded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
                self._jpeg = (number, encoded.tobytes())
            return self._jpeg

    async def next_frame(self, last: int, patience: float | None = None) -> tuple[int, bytes] | None:
        """The latest frame, if it is another than one that was seen.

        Args:
            last: its number; 0 before the first.
            patience: s to wait for another, None for ever.

        Returns:
            Number and JPEG, or None if there was none in time or the view was closed.
        """
        try:
            async with asyncio.timeout(patience):
                while not self._closed:
                    if self._latest is not None and self._latest[0] > last:
                        return await asyncio.to_thread(self.latest)
                    await asyncio.sleep(1.0 / MOST_RATE)
        except TimeoutError:
            pass
        return None


def _application(live: LiveFilm, title: str) -> ASGIApp:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
    from starlette.routing import Mount, Route
    from starlette.staticfiles import StaticFiles

    async def page(_: Request) -> Response:
        return FileResponse(STATIC / "live.html")

    async def name(_: Request) -> Response:
        return JSONResponse({"title": title})

    async def frame(_: Request) -> Response:
        frame_ = await live.next_frame(0, STUCK)
        if frame_ is None:
            return PlainTextResponse("no frame yet", 503)
        return Response(frame_[1], media_type="image/jpeg")

    async def frames() -> AsyncIterator[bytes]:
        last = 0
        while (latest := await live.next_frame(last)) is not None:
            last, jpeg = latest
            head = b"--%s\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % (BOUNDARY, len(jpeg))
            yield head + jpeg + b"\r\n"
            await asyncio.sleep(1.0 / MOST_RATE)
        yield b"--%s--\r\n" % BOUNDARY

    async def stream(_: Request) -> Response:
        kind = f"multipart/x-mixed-replace; boundary={BOUNDARY.decode()}"
        return StreamingResponse(frames(), media_type=kind)

    return Starlette(routes=[
        Route("/", page),
        Route("/title", name),
        Route("/frame.jpg", frame),
        Route("/stream", stream),
        Mount("/static", StaticFiles(directory=STATIC)),
    ])  # fmt: skip
