"""A trial to be watched while it runs: a page on this machine, for any browser."""

from __future__ import annotations

import html
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType

import cv2

from hybridmap.errors import SettingsError
from mapweave.trial.scene import Frame

HOST = "127.0.0.1"
PORT = 8090
MOST_RATE = 20.0
"""Frames that a viewer gets in a wall second, at most: watching shall not slow the trial down."""
QUALITY = 80
"""Of the JPEG, percent."""
STUCK = 5.0
"""s; a viewer that takes nothing for this long is dropped."""
BOUNDARY = "frame"
PAGE = """<!doctype html>
<meta charset="utf-8">
<title>{title}</title>
<style>
  body {{ margin: 0; background: #fff; color: #555; font: 14px sans-serif; text-align: center }}
  img {{ max-width: 100%; max-height: 100vh }}
</style>
<img src="/stream" alt="The trial is over." onerror="this.replaceWith(this.alt)">
"""


class Live:
    """Shows the latest frame to any number of viewers; the trial never waits for them.

    Attributes:
        url: of the page.
        page: itself, HTML.
    """

    def __init__(self, port: int = PORT, title: str = "Mapweave") -> None:
        """Begin to serve.

        Args:
            port: on this machine's loopback; 0 takes a free one.
            title: of the page.

        Raises:
            SettingsError: the port is in use, or may not be used.
        """
        self.page = PAGE.format(title=html.escape(title)).encode()
        self._changed = threading.Condition()
        self._encoding = threading.Lock()
        self._frame: Frame | None = None
        self._number = 0
        self._jpeg = (0, b"")
        self._closing = threading.Event()
        try:
            self._server = _Server((HOST, port), self)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or error
            raise SettingsError(f"the live view cannot use port {port} ({why}); choose another") from None
        self.url = f"http://{HOST}:{self._server.server_port}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="live", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> Live:
        """Nothing more to do."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop serving."""
        self.close()

    def show(self, frame: Frame) -> None:
        """Replace what is shown, (H, W, 3) blue, green, red; it must not be changed afterwards."""
        with self._changed:
            self._frame = frame
            self._number += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Stop serving; every viewer's stream ends. Twice is no error."""
        if self._closing.is_set():
            return
        self._closing.set()
        with self._changed:
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def wait_for_frame(self, seen: int, patience: float | None = None) -> tuple[int, bytes] | None:
        """The latest frame, if it is another than one that was seen.

        Args:
            seen: its number; 0 before the first.
            patience: s to wait for another, None for ever.

        Returns:
            Number and JPEG, or None if there was none in time or the view was closed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._number > seen or self._closing.is_set(), patience)
            number, frame = self._number, self._frame
        if number <= seen or frame is None or self._closing.is_set():
            return None
        with self._encoding:
            # Another viewer may have asked for the same one.
            if self._jpeg[0] < number:
                self._jpeg = (
                    number,
                    cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes(),
                )
            return self._jpeg

    def pause(self) -> bool:
        """Wait for as long as a frame lasts; whether the view goes on."""
        return not self._closing.wait(1.0 / MOST_RATE)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], live: Live) -> None:
        self.live = live
        super().__init__(address, _Viewer)


class _Viewer(BaseHTTPRequestHandler):
    """One request of one viewer, in its own thread."""

    server: _Server
    timeout = STUCK

    def do_GET(self) -> None:
        """The page, the stream or one frame."""
        try:
            match self.path.partition("?")[0]:
                case "/":
                    self._send("text/html; charset=utf-8", self.server.live.page)
                case "/frame.jpg":
                    self._send_frame()
                case "/stream":
                    self._send_stream()
                case _:
                    self.send_error(HTTPStatus.NOT_FOUND)
        except (ConnectionError, TimeoutError):
            # The viewer has gone, or takes nothing any more.
            self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: the terminal belongs to the trial."""

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def _send_frame(self) -> None:
        found = self.server.live.wait_for_frame(0, STUCK)
        if found is None:
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, "no frame yet")
        else:
            self._send("image/jpeg", found[1])

    def _send_stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        live, seen = self.server.live, 0
        while (found := live.wait_for_frame(seen)) is not None:
            seen, jpeg = found
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            self.wfile.write(head.encode() + jpeg + b"\r\n")
            if not live.pause():
                break
        self.wfile.write(f"--{BOUNDARY}--\r\n".encode())
