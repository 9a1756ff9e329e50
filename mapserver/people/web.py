"""The map server for people: a photograph in, JSON out, why maps are one, why routes lead so, and pages.

    GET /             the page for photographs
    GET /why          the page that says why maps are one, or are not
    GET /status       what the server holds, JSON
    GET /history      what has joined, come apart and been ruled, with dates, JSON
    GET /explain      why maps are one, or are not; with ?a=r0.1.17&b=r1.1.5 two nodes or two maps, JSON
    GET /route        why a route leads as it does: ?a=r0.1.17&b=r1.1.5 from the one to the other, JSON
    POST /relocalize  an image (the body itself, or a form's part `image`) -> where it was taken, JSON

Whatever goes wrong comes back as one JSON object with `error`. A server that is busy answers 503 with
Retry-After in whole seconds and `retry_after` exactly.
"""

from __future__ import annotations

import errno
import json
import logging
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Protocol, cast
from urllib.parse import parse_qsl, urlsplit

from hybridmap.errors import Busy, InvalidValue, MapweaveError, NotConnected, SettingsError
from hybridmap.explanation import Explanation
from hybridmap.history import Happening
from hybridmap.query import RelocalizeAnswer, View
from hybridmap.ruling import EXAMPLE, read_ends
from mapserver.people.answer_json import answer_record
from mapserver.people.explanation_json import explanation_record, history_record
from mapserver.people.form import read_photo
from mapserver.people.page import PAGE
from mapserver.people.same_site import check_site, own_names
from mapserver.people.why_page import WHY_PAGE
from wire.explanation_messages import ExplainRequest
from wire.log_messages import Scalar

log = logging.getLogger(__name__)

PAGES = {"/": PAGE, "/why": WHY_PAGE}
MOST_BYTES = 16 * 2**20
"""Longest body, 16 MiB."""
PATIENCE = 10.0
"""How long somebody may take to send a request, and an answer may take, s."""
MOST_AT_ONCE = 32
"""Connections that are served at once; the next one is refused."""
POLL = 0.05
"""How soon the server notices that it is closed, s."""

QUESTIONS = ("/explain", "/route")
PATHS = dict.fromkeys(("/", "/why", "/status", "/history", *QUESTIONS), "GET") | {"/relocalize": "POST"}


class Answering(Protocol):
    """What is asked, as of a MapServer: from any thread; what cannot be answered raises a MapweaveError."""

    def locate(self, look: Callable[[], View], ticket: int) -> Future[RelocalizeAnswer]:
        """Where a view was taken."""

    def explain(self, request: ExplainRequest) -> Future[Explanation]:
        """Why maps are one, or a route leads so."""

    def status(self) -> dict[str, Scalar]:
        """What the server holds and does."""

    def history(self) -> tuple[Happening, ...]:
        """What has happened."""


def parse_address(text: str) -> tuple[str, int]:
    """`PORT` (loopback only) or `HOST:PORT`.

    Raises:
        SettingsError: it is neither.
    """
    host, colon, port = text.rpartition(":")
    host = host.strip("[]") if colon else "127.0.0.1"
    if not host or not port.isascii() or not port.isdigit() or not 1 <= int(port) <= 65535:
        raise SettingsError(f"http {text!r}: write a port, or HOST:PORT, for example 8080 or 0.0.0.0:8080")
    return host, int(port)


class Web:
    """Listens from the start until closed. A context manager."""

    def __init__(self, address: tuple[str, int], server: Answering) -> None:
        """Open the port and serve on threads of its own.

        Args:
            address: host and port; port 0 takes any.
            server: answers.

        Raises:
            NotConnected: nobody can listen there, for example since the port is taken.
        """
        try:
            self._server = _Server(address, server)
        except OSError as error:
            reason = "the port is taken" if error.errno == errno.EADDRINUSE else error.strerror or str(error)
            raise NotConnected(f"cannot listen at http {address[0]}:{address[1]}: {reason}") from None
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(POLL,), name="web", daemon=True
        )
        self._thread.start()

    @property
    def port(self) -> int:
        """The port that it listens at."""
        return int(self._server.server_address[1])

    def __enter__(self) -> Web:
        """Nothing more to do."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(self, address: tuple[str, int], server: Answering) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        super().__init__(address, _Handler)
        self.server = server
        self.names = own_names(address[0])
        self.places = threading.BoundedSemaphore(MOST_AT_ONCE)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Clients that hang up are no news."""
        log.debug("the connection with %s broke", client_address, exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    timeout = PATIENCE
    protocol_version = "HTTP/1.1"

    def handle_one_request(self) -> None:
        """One request a connection: what one sends late holds up nobody."""
        super().handle_one_request()
        self.close_connection = True

    def do_GET(self) -> None:
        """The pages, the status, why maps are one, and why routes lead so."""
        if self._is_foreign():
            return
        address = urlsplit(self.path)
        if address.path in PAGES:
            self._send(HTTPStatus.OK, PAGES[address.path].encode(), "text/html; charset=utf-8")
        elif address.path == "/status":
            self._tell(HTTPStatus.OK, self._web.server.status())
        elif address.path == "/history":
            self._tell(HTTPStatus.OK, history_record(self._web.server.history()))
        elif address.path in QUESTIONS:
            query = dict(parse_qsl(address.query, keep_blank_values=True))
            self._answer(lambda: self._explain(address.path, query))
        else:
            self._no_such(address.path)

    def do_POST(self) -> None:
        """Where was this taken?"""
        if self._is_foreign():
            return
        address = urlsplit(self.path)
        if address.path != "/relocalize":
            self._no_such(address.path)
            return
        length = self._length()
        if length is not None:
            query = dict(parse_qsl(address.query, keep_blank_values=True))
            self._answer(lambda: self._relocalize(length, query))

    def _relocalize(self, length: int, query: dict[str, str]) -> Mapping[str, Any]:
        body = self._read(length)
        if len(body) < length:
            raise InvalidValue(f"only {len(body)} of {length} bytes came")
        photo = read_photo(self.headers.get("Content-Type", ""), body, query)
        photo.check()
        return answer_record(self._web.server.locate(photo.view, hash(photo.data)).result(PATIENCE))

    def _read(self, length: int) -> bytes:
        """The body; the time that it may take is one for all of it."""
        end = time.monotonic() + self.timeout
        body = bytearray()
        while len(body) < length:
            left = end - time.monotonic()
            if left <= 0.0:
                raise TimeoutError
            self.connection.settimeout(left)
            piece = self.rfile.read1(min(length - len(body), 1 << 18))
            if not piece:
                break
            body += piece
        return bytes(body)

    def _is_foreign(self) -> bool:
        """Whether another site's page asks; it is told so."""
        try:
            check_site(self.headers.get("Host"), self.headers.get("Origin"), self._web.names)
        except InvalidValue as error:
            self.send_error(HTTPStatus.FORBIDDEN, str(error))
            return True
        return False

    def _explain(self, path: str, query: dict[str, str]) -> Mapping[str, Any]:
        ends, route = None, path == "/route"
        if query or route:
            if query.keys() != {"a", "b"}:
                raise InvalidValue(f"write {path}?a=r0.1.17&b=r1.1.5: {EXAMPLE}")
            ends = read_ends(query["a"].strip(), query["b"].strip())
        return explanation_record(self._web.server.explain(ExplainRequest(ends, route)).result(PATIENCE))

    def _answer(self, answer: Callable[[], Mapping[str, Any]]) -> None:
        """Tell what comes of a question that takes long, or why nothing does."""
        if not self._web.places.acquire(blocking=False):
            self._busy(Busy(1.0))
            return
        try:
            content = answer()
        except Busy as busy:
            self._busy(busy)
        except InvalidValue as error:
            self.send_error(HTTPStatus.BAD_REQUEST, str(error))
        except MapweaveError as error:
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
        except TimeoutError:
            self.send_error(
                HTTPStatus.REQUEST_TIMEOUT, f"no whole image, or no answer, within {PATIENCE:g} s"
            )
        except Exception as error:  # a defect here must not look like a broken network
            log.exception("no answer to %s", self.path)
            self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR, f"the server failed: {error}")
        else:
            self._tell(HTTPStatus.OK, content)
        finally:
            self._web.places.release()

    def handle_expect_100(self) -> bool:
        """Refuse what is too long before it is sent."""
        return self._length() is not None and super().handle_expect_100()

    def _length(self) -> int | None:
        """Of the body; None if that was refused."""
        text = self.headers.get("Content-Length", "")
        if not (text.isascii() and text.isdigit()):
            self.send_error(HTTPStatus.LENGTH_REQUIRED, "say how long the image is with Content-Length")
        elif len(text) > 12 or int(text) > MOST_BYTES:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {MOST_BYTES >> 20} MiB are taken")
        elif int(text) == 0:
            self.send_error(HTTPStatus.BAD_REQUEST, "send a JPEG or PNG image as the body")
        else:
            return int(text)
        return None

    @property
    def _web(self) -> _Server:
        return cast(_Server, self.server)

    def _no_such(self, path: str) -> None:
        if path in PATHS:
            self.send_error(HTTPStatus.METHOD_NOT_ALLOWED, f"use {PATHS[path]} for {path}")
        else:
            there = ", ".join(f"{method} {one}" for one, method in PATHS.items())
            self.send_error(HTTPStatus.NOT_FOUND, f"there are {there}")

    def _busy(self, busy: Busy) -> None:
        self._tell(
            HTTPStatus.SERVICE_UNAVAILABLE,
            {"error": str(busy), "retry_after": round(busy.retry_after, 2)},
            {"Retry-After": str(math.ceil(busy.retry_after))},
        )

    def _tell(self, code: int, content: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> None:
        self._send(code, json.dumps(content).encode() + b"\n", "application/json", headers)

    def _send(
        self, code: int, body: bytes, content_type: str, headers: Mapping[str, str] | None = None
    ) -> None:
        self.send_response(code)
        fixed = {
            "Content-Type": content_type, "Content-Length": str(len(body)), "Connection": "close",
            "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff",
        }  # fmt: skip
        for name, value in {**fixed, **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)
        if code >= HTTPStatus.BAD_REQUEST:
            self._hear_out()

    def _hear_out(self) -> None:
        """Let a client finish sending what was refused: a connection that is reset loses the answer too."""
        self.wfile.flush()
        try:
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(1.0)
            end = time.monotonic() + PATIENCE
            while self.connection.recv(1 << 18) and time.monotonic() < end:
                pass
        except OSError:
            return

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Errors of HTTP itself as JSON, too."""
        self._tell(code, {"error": message or HTTPStatus(code).phrase})

    def version_string(self) -> str:
        """Nobody needs to know more."""
        return "Mapweave"

    def log_message(self, format: str, *args: Any) -> None:
        """Into the log, not onto the screen."""
        log.debug("%s " + format, self.address_string(), *args)
