"""ASGI applications on a thread of their own, by uvicorn, with limits on what a connection may take.

Each connection carries one request, or a WebSocket. The head of the request has a time limit, so has the
connection as a whole unless it is a WebSocket, and a peer that takes nothing of an answer is dropped. Uvicorn
by itself waits for ever in all three cases.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
import logging
import select
import socket
import ssl
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import h11
import msgspec
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from mapweave.hybridmap.errors import NotConnected
from mapweave.mapserver.http.websocket import WebSocketConnection

log = logging.getLogger(__name__)

MAX_HEAD_BYTES = 16384
"""Of a request: its first line and headers."""
MAX_CONNECTIONS = 1024
"""At once; a new one takes the place of the oldest that waits. A limit for requests."""
MAX_WAITING = 512
"""Connections that have not sent the head of a request yet; a new one takes the place of the oldest."""
LINGER = 1.0
"""s in which a peer may finish sending what is refused: a connection that is reset loses the answer too."""
MAX_VIEWER_BYTES = 1024
"""Of a message by a viewer, which has nothing to say."""
GRACE = 1.0
"""s in which requests in work may end when the server ends."""
STEP = 0.005
"""s between two looks at whether that has happened."""
ARRIVAL = 10
"""Steps in which a request may still arrive then, of a client that has connected before. Steps, and not a
time: while a library loads or computes, the server's thread may come to nothing for longer than that."""
NO_FILES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
"""Errors of a process, or a machine, that can open no more connections."""
REMINDER = 60.0
"""s between two lines about that."""
START = 10.0
"""s in which the thread has to be there."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
"""Content security policy of the pages: files of this server only, nothing inline."""
HEADERS = {
    "Connection": "close",
    "Cache-Control": "no-store",
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Server": "Mapweave",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


@dataclass(frozen=True, slots=True)
class ConnectionTimeouts:
    """Times after which a connection is dropped, s.

    Attributes:
        head: until the head of a request is there.
        whole: from its beginning to its end; None for streams.
        stall: in which the peer takes nothing of what is sent.
    """

    head: float = 10.0
    whole: float | None = 40.0
    stall: float = 10.0


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """One line."""
    return msgspec.json.encode(content) + b"\n"


class Connection(H11Protocol):
    """One connection with its time limits."""

    limits = ConnectionTimeouts()
    waiting: dict[Connection, None]
    _head: asyncio.TimerHandle
    _whole: asyncio.TimerHandle | None = None
    _stall: asyncio.TimerHandle | None = None
    _refused = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the clocks; make room if there are too many."""
        super().connection_made(transport)
        self._head = self.loop.call_later(self.limits.head, transport.abort)
        if self.limits.whole is not None:
            self._whole = self.loop.call_later(self.limits.whole, transport.abort)
        self.waiting[self] = None
        if len(self.waiting) > MAX_WAITING or len(self.connections) > MAX_CONNECTIONS:
            oldest = next(iter(self.waiting))
            del self.waiting[oldest]
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clocks."""
        self.waiting.pop(self, None)
        for timer in (self._head, self._whole, self._stall):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Go on, unless what comes was refused.

        The parser counts the bytes of a head only while its end is missing: a long head that comes in one
        read would pass, and in two it would not. So it gets no more than a head before the head is there.
        """
        while data and not self._refused:
            room = len(data)
            if self.conn.their_state is h11.IDLE:
                room = max(MAX_HEAD_BYTES - len(self.conn.trailing_data[0]), 1)
            super().data_received(data[:room])
            data = data[room:]

    def eof_received(self) -> bool:  # type: ignore[override]
        """A peer that has sent a whole request may still wait for the answer."""
        if not self.transport.can_write_eof():
            return False  # TLS knows no half of a connection
        return self.cycle is not None and not self.cycle.more_body and not self.cycle.response_complete

    def handle_events(self) -> None:
        """Take note of the head of the request."""
        super().handle_events()
        if self.cycle is not None:
            self._head.cancel()
            self.waiting.pop(self, None)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand a viewer on: it stays as long as it likes, within limits of its own."""
        for timer in (self._head, self._whole, self._stall):
            if timer is not None:
                timer.cancel()
        self.waiting.pop(self, None)
        super().handle_websocket_upgrade(event)

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP as everything else is answered, and let the peer finish sending."""
        body = json_bytes(
            {"error": f"no HTTP request, or one with a head of more than {MAX_HEAD_BYTES} bytes"}
        )
        fixed = {**HEADERS, "Content-Type": "application/json", "Content-Length": str(len(body))}
        try:
            answer = h11.Response(status_code=400, headers=list(fixed.items()), reason=b"Bad Request")
            parts = [self.conn.send(event) for event in (answer, h11.Data(data=body), h11.EndOfMessage())]
        except h11.LocalProtocolError:
            # Another answer has begun.
            self.transport.abort()
            return
        self._refused = True
        self.transport.write(b"".join(part for part in parts if part))
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self._head.cancel()
        self._head = self.loop.call_later(LINGER, self.transport.abort)

    def pause_writing(self) -> None:
        """The peer is slower than what is sent."""
        super().pause_writing()
        self._stall = self.loop.call_later(self.limits.stall, self.transport.abort)

    def resume_writing(self) -> None:
        """It has taken something."""
        super().resume_writing()
        if self._stall is not None:
            self._stall.cancel()


class _Loop(asyncio.SelectorEventLoop):
    """A TLS handshake has the time limit of a head; by itself asyncio waits for 60 s.

    So many of them wait at most, as of heads: a connection is no `Connection` before its handshake is done.
    """

    def __init__(self, handshake: float) -> None:
        super().__init__()
        self._handshake = handshake
        self._next_line = 0.0
        self.shaking: dict[asyncio.Future[None], asyncio.Transport] = {}

    def _accept_connection(
        self, factory: Any, listening: socket.socket, tls: Any, server: Any, backlog: int, *rest: Any
    ) -> None:
        """Accept one connection at a time.

        Where no file may be opened any more, asyncio reports that `backlog` times, and so often again after
        each second. What waits stays in the queue of the system.
        """
        del backlog
        super()._accept_connection(factory, listening, tls, server, 1, *rest)  # type: ignore[misc]

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """Say in one line now and then that no connection can be taken; leave all else to asyncio."""
        error, now = context.get("exception"), time.monotonic()
        if not (isinstance(error, OSError) and error.errno in NO_FILES):
            super().call_exception_handler(context)
        elif now >= self._next_line:
            self._next_line = now + REMINDER
            log.error("no more connections can be taken: %s", error.strerror)

    async def create_server(self, *arguments: Any, **named: Any) -> asyncio.Server:
        if named.get("ssl") is not None:
            named.update(ssl_handshake_timeout=self._handshake, ssl_shutdown_timeout=LINGER)
        return await super().create_server(*arguments, **named)

    def _make_ssl_transport(self, *arguments: Any, **named: Any) -> asyncio.Transport:
        """Begin a handshake, in the place of the oldest if there are too many."""
        transport: asyncio.Transport = super()._make_ssl_transport(*arguments, **named)  # type: ignore[misc]
        waiter: asyncio.Future[None] = named["waiter"]
        self.shaking[waiter] = transport
        waiter.add_done_callback(lambda done: self.shaking.pop(done, None))
        if len(self.shaking) > MAX_WAITING:
            # Later: in a burst the oldest has no socket yet.
            self.call_soon(self.shaking.pop(next(iter(self.shaking))).abort)
        return transport


class _Server(uvicorn.Server):
    """Ends as soon as it is to and no request is in work; uvicorn itself looks ten times a second."""

    def __init__(self, config: uvicorn.Config, arriving: Callable[[], bool]) -> None:
        super().__init__(config)
        self._ending, self._arriving = asyncio.Event(), arriving

    def end(self) -> None:
        """Stop serving. In the server's loop."""
        self.should_exit = True
        self._ending.set()

    async def main_loop(self) -> None:
        """Serve until it is to end. The headers of answers never change; uvicorn makes them each second."""
        if not await self.on_tick(0):
            await self._ending.wait()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End every connection, also those of peers that take nothing; requests in work have a moment.

        With its port a connection is reset that has not been accepted, and one that was, a moment before, is
        not among the connections yet and would stay open without an answer.
        """
        await _while(lambda: any(map(_is_waited_for, sockets or ())), 0.0)
        for listening in (*self.servers, *(sockets or ())):
            listening.close()
        await _while(self._arriving, 0.0)
        state = self.server_state
        for connection in list(state.connections):
            connection.shutdown()
        await _while(lambda: bool(state.connections or state.tasks), GRACE)
        for task in state.tasks:
            task.cancel()
        for connection in list(state.connections):
            connection.transport.abort()
        await asyncio.sleep(0)


def _is_waited_for(listening: socket.socket) -> bool:
    """Whether a connection waits to be accepted."""
    waiting = select.poll()
    waiting.register(listening, select.POLLIN)
    return bool(waiting.poll(0))


async def _while(holds: Callable[[], bool], seconds: float) -> None:
    """Wait at least one step, and at most so many seconds or the steps of an arrival, if they take longer."""
    end = time.monotonic() + seconds
    await asyncio.sleep(STEP)
    for step in itertools.count(1):
        if not holds() or (step >= ARRIVAL and time.monotonic() >= end):
            return
        await asyncio.sleep(STEP)


class HttpThread:
    """Serves an application from the start until closed. A context manager."""

    def __init__(
        self,
        app: ASGIApp,
        address: tuple[str, int],
        limits: ConnectionTimeouts | None = None,
        name: str = "http",
        tls: ssl.SSLContext | None = None,
    ) -> None:
        """Open the port and serve.

        Args:
            app: answers.
            address: host and port; port 0 takes any.
            limits: of connections.
            name: of the thread.
            tls: serves HTTPS.

        Raises:
            NotConnected: the port cannot be used, with the reason alone.
        """
        self._socket = _listen(address)
        self.port = int(self._socket.getsockname()[1])
        limits = limits or ConnectionTimeouts()
        protocol: type[Connection] = type("Connection", (Connection,), {"limits": limits, "waiting": {}})
        viewer = type("Viewer", (WebSocketConnection,), {"stall": limits.stall})
        config = uvicorn.Config(
            app,
            http=protocol,
            loop="asyncio",
            ws=viewer,
            ws_max_size=MAX_VIEWER_BYTES,
            ws_ping_interval=limits.stall,
            ws_ping_timeout=limits.stall,
            lifespan="off",
            interface="asgi3",
            # The terminal belongs to the program that serves.
            log_config=None,
            log_level=logging.CRITICAL,
            access_log=False,
            server_header=False,
            date_header=False,
            headers=list(HEADERS.items()),
            # A head whose end is not among so many bytes is longer.
            h11_max_incomplete_event_size=MAX_HEAD_BYTES - 1,
            # A proxy on this machine names the client for which it asks.
            forwarded_allow_ips="127.0.0.1,::1",
        )
        config.load()
        config.ssl = tls
        self._loop = loop = _Loop(limits.head)
        self._server = _Server(config, lambda: bool(protocol.waiting or loop.shaking))
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        end = time.monotonic() + START
        while not self._server.started and self._thread.is_alive() and time.monotonic() < end:
            time.sleep(0.005)
        if not self._server.started:
            raise NotConnected("the server's thread did not start")

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._server.serve(sockets=[self._socket]))

    @property
    def connections(self) -> int:
        """Open at present."""
        return len(self._server.server_state.connections)

    def __enter__(self) -> HttpThread:
        """Nothing more to do."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop serving."""
        self.close()

    def close(self) -> None:
        """Stop serving; connections end. Idempotent."""
        with contextlib.suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._server.end)
        self._thread.join(10.0)


_UNUSABLE = {
    errno.EADDRINUSE: "the port is taken; choose another one",
    errno.EACCES: "ports below 1024 are for root alone; choose another one, for example 8080",
}
"""Why a port cannot be had, by the error's number."""


def _listen(address: tuple[str, int]) -> socket.socket:
    listening = socket.socket(socket.AF_INET6 if ":" in address[0] else socket.AF_INET)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(address)
        listening.listen(MAX_CONNECTIONS)
    except (OSError, OverflowError) as error:
        listening.close()
        reason = _UNUSABLE.get(getattr(error, "errno", 0)) or getattr(error, "strerror", None)
        raise NotConnected(str(reason or error)) from None
    return listening
