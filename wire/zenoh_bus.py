"""The bus over Zenoh. The only file that imports zenoh.

An agent is a client of a router; the map server's session is that router. A client opens in a thread of its
own, since opening without a router fails: constructing a bus never blocks and a missing router is no error.
From the first connection on Zenoh itself reconnects and declares again.
"""

from __future__ import annotations

import json
import logging
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

import zenoh

from hybridmap.errors import NotConnected
from wire.bus import Closing, Reply, Request, Sample
from wire.bus_settings import BusSettings
from wire.dispatch import Dispatcher
from wire.keyexpr import check_key, check_pattern, is_key

log = logging.getLogger(__name__)

REFUSED = b"refused: "
"""Marks an error reply that a handler made; all others are Zenoh's own, like its "Timeout"."""

EXIT_THREAD = "zenoh-close-at-exit"
_exit_lock = threading.Lock()
_open_buses: weakref.WeakSet[ZenohBus] = weakref.WeakSet()


class ZenohBus:
    """A connection to the fleet over Zenoh. Close it: an open session can hang the interpreter's exit."""

    def __init__(self, settings: BusSettings | None = None) -> None:
        """Connect, or begin to.

        Args:
            settings: a client of the default router if not given.

        Raises:
            NotConnected: a router cannot listen where it should, for example since the port is taken.
        """
        self._settings = settings or BusSettings()
        self._lock = threading.RLock()
        self._closed = threading.Event()
        self._session: zenoh.Session | None = None
        self._declared: list[_Declared] = []
        self._open_requests: set[_ZenohRequest] = set()
        self._connecting = threading.Thread(target=self._connect, name="zenoh-connect", daemon=True)
        if self._settings.mode == "router":
            self._session = _open_router(self._settings)
        self._dispatcher = Dispatcher(f"zenoh-{self._settings.mode}", self._settings.queue_limit)
        _remember(self)
        if self._session is None:
            self._connecting.start()

    def publish(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        """Send best-effort. Without a connection the message is lost."""
        check_key(key)
        session = self._session
        if session is None:
            return
        try:
            session.put(key, payload, attachment=attachment or None)
        except zenoh.ZError:
            # The session was closed between the look and the put: the same as no connection.
            log.debug("put on %s after the session was closed", key)

    def subscribe(self, pattern: str, handler: Callable[[Sample], None]) -> Closing:
        """Call the handler with each matching message."""
        return self._declare(_Subscription(self, check_pattern(pattern), handler))

    def serve(self, key: str, handler: Callable[[Request], None]) -> Closing:
        """Answer questions."""
        return self._declare(_Service(self, check_pattern(key), handler))

    def ask(self, key: str, payload: bytes, timeout: float) -> list[Reply]:
        """Ask everyone who serves the key (or a key that the pattern matches)."""
        check_pattern(key)
        session = self._session
        if session is None:
            return []
        try:
            # Every server is asked, and each answer comes as soon as it is there: the default consolidation
            # holds a quick answer back until the slowest server's.
            replies = list(
                session.get(
                    key,
                    payload=payload,
                    timeout=timeout,
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                )
            )
        except zenoh.ZError as error:
            log.debug("asking %s failed: %s", key, error)
            return []
        return [reply for reply in map(_read_reply, replies) if reply is not None]

    def announce(self, key: str) -> Closing:
        """Be alive under this key."""
        return self._declare(_Token(self, check_key(key)))

    def watch(self, pattern: str, handler: Callable[[str, bool], None]) -> Closing:
        """Call the handler with who is alive, now and at each change."""
        return self._declare(_Watcher(self, check_pattern(pattern), handler))

    def connected(self) -> bool:
        """Whether messages can leave now. A router is always connected."""
        session = self._session
        if session is None or session.is_closed():
            return False
        return self._settings.mode == "router" or bool(session.info.routers_zid())

    def wait_connected(self, timeout: float) -> bool:
        """Wait until connected; returns False when the time is over."""
        end = time.monotonic() + timeout
        while not self.connected() and not self._closed.is_set() and time.monotonic() < end:
            self._closed.wait(0.01)
        return self.connected()

    @property
    def messages_lost(self) -> int:
        """Messages that found the handlers' queue full."""
        return self._dispatcher.lost

    def close(self) -> None:
        """Take everything back and disconnect."""
        with self._lock:
            if self._closed.is_set():
                return
            self._closed.set()
            session, self._session = self._session, None
            declared, self._declared = self._declared, []
        if self._connecting.is_alive():
            self._connecting.join()
        self._dispatcher.close()
        for request in list(self._open_requests):
            request.abandon()
        for one in declared:
            one.close()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        _open_buses.discard(self)

    def _declare(self, declared: _D) -> _D:
        with self._lock:
            if self._closed.is_set():
                raise NotConnected("this bus is closed")
            self._declared.append(declared)
            if self._session is not None:
                declared.declare(self._session)
        return declared

    def _connect(self) -> None:
        """Try until there is a router, then declare what was asked for in the meantime."""
        config = _config(self._settings)
        wait = self._settings.retry_first
        told = False
        while not self._closed.is_set():
            try:
                session = zenoh.open(config)
            except zenoh.ZError as error:
                if not told:
                    log.info("no router at %s yet, trying on", ", ".join(self._settings.endpoints))
                    log.debug("zenoh says: %s", error)
                    told = True
                self._closed.wait(wait)
                wait = min(2 * wait, self._settings.retry_longest)
                continue
            with self._lock:
                if not self._closed.is_set():
                    for declared in self._declared:
                        declared.declare(session)
                    self._session = session
                    return
            session.close()  # type: ignore[no-untyped-call]


class _Declared:
    """Something declared on a bus; it is declared in Zenoh as soon as there is a session."""

    def __init__(self, bus: ZenohBus, key: str) -> None:
        self.bus = bus
        self.key = key
        self._open = True
        self._entity: Any = None

    def declare(self, session: zenoh.Session) -> None:
        self._entity = self._declare_in(session)

    def _declare_in(self, session: zenoh.Session) -> Any:
        raise NotImplementedError

    def close(self) -> None:
        with self.bus._lock:
            if not self._open:
                return
            self._open = False
            if self in self.bus._declared:
                self.bus._declared.remove(self)
            entity, self._entity = self._entity, None
        if entity is not None:
            entity.undeclare()

    def wanted(self) -> bool:
        return self._open


_D = TypeVar("_D", bound=_Declared)


class _Token(_Declared):
    def _declare_in(self, session: zenoh.Session) -> Any:
        return session.liveliness().declare_token(self.key)


class _Subscription(_Declared):
    def __init__(self, bus: ZenohBus, key: str, handler: Callable[[Sample], None]) -> None:
        super().__init__(bus, key)
        self._handler = handler

    def _declare_in(self, session: zenoh.Session) -> Any:
        return session.declare_subscriber(self.key, self._receive)

    def _receive(self, sample: zenoh.Sample) -> None:
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
        message = Sample(str(sample.key_expr), sample.payload.to_bytes(), attachment)
        self.bus._dispatcher.message(self._handler, message, self.wanted)


class _Service(_Declared):
    def __init__(self, bus: ZenohBus, key: str, handler: Callable[[Request], None]) -> None:
        super().__init__(bus, key)
        self._handler = handler

    def _declare_in(self, session: zenoh.Session) -> Any:
        return session.declare_queryable(self.key, self._receive)

    def _receive(self, query: zenoh.Query) -> None:
        asked = str(query.key_expr)
        # A reply goes out on one key that the question's pattern matches: that of the service.
        key = asked if is_key(asked) else self.key
        self.bus._dispatcher.question(self._handler, _ZenohRequest(self.bus, key, query), self.wanted)


class _Watcher(_Declared):
    def __init__(self, bus: ZenohBus, key: str, handler: Callable[[str, bool], None]) -> None:
        super().__init__(bus, key)
        self._handler = handler
        self._seen: set[str] = set()

    def _declare_in(self, session: zenoh.Session) -> Any:
        return session.liveliness().declare_subscriber(self.key, self._receive, history=True)

    def _receive(self, sample: zenoh.Sample) -> None:
        key, alive = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
        # History and news may both tell of the same token.
        if alive != (key in self._seen):
            (self._seen.add if alive else self._seen.discard)(key)
            self.bus._dispatcher.presence(self._handler, key, alive, self.wanted)


class _ZenohRequest:
    """A question. Its query must be dropped after the answer, or the asker waits for the time-out."""

    def __init__(self, bus: ZenohBus, key: str, query: zenoh.Query) -> None:
        self._bus = bus
        self._key = key
        self._payload = query.payload.to_bytes() if query.payload is not None else b""
        self._query = query
        self._lock = threading.Lock()
        self._answered = False
        bus._open_requests.add(self)

    @property
    def key(self) -> str:
        return self._key

    @property
    def payload(self) -> bytes:
        return self._payload

    def reply(self, payload: bytes) -> None:
        self._finish(lambda: self._query.reply(self._key, payload))

    def refuse(self, reason: str) -> None:
        self._finish(lambda: self._query.reply_err(REFUSED + (reason or "refused").encode()))

    def abandon(self) -> None:
        """Nobody will answer: the bus closes."""
        self._finish(lambda: None)

    def _finish(self, answer: Callable[[], None]) -> None:
        with self._lock:
            if self._answered:
                return
            self._answered = True
        try:
            answer()
        except zenoh.ZError as error:
            log.debug("an answer on %s found no way back: %s", self._key, error)
        finally:
            self._query.drop()  # type: ignore[no-untyped-call]
            self._bus._open_requests.discard(self)


def _read_reply(reply: zenoh.Reply) -> Reply | None:
    if reply.ok is not None:
        return Reply(payload=reply.ok.payload.to_bytes())
    payload = reply.err.payload.to_bytes() if reply.err is not None else b""
    if not payload.startswith(REFUSED):
        # Zenoh's own "Timeout": somebody has not answered, which the list shows by its length.
        return None
    return Reply(error=payload[len(REFUSED) :].decode(errors="replace"))


def _open_router(settings: BusSettings) -> zenoh.Session:
    try:
        return zenoh.open(_config(settings))
    except zenoh.ZError as error:
        where = ", ".join(settings.listen)
        if "in use" in str(error):
            raise NotConnected(
                f"cannot listen at {where}: the port is taken; stop the other server or choose another port"
            ) from None
        raise NotConnected(f"cannot listen at {where}: {str(error).split(' at /')[0]}") from None


def _config(settings: BusSettings) -> zenoh.Config:
    """The session settings: nothing is found by chance, everything is where the settings say."""
    retry = {
        "period_init_ms": round(settings.retry_first * 1e3),
        "period_max_ms": round(settings.retry_longest * 1e3),
        "period_increase_factor": 2,
    }
    values: dict[str, object] = {
        "mode": settings.mode,
        "connect/endpoints": list(settings.endpoints) if settings.mode == "client" else [],
        "listen/endpoints": list(settings.listen) if settings.mode == "router" else [],
        "connect/retry": retry,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # There is nobody to scout for, so opening a router need not wait half a second for it.
        "scouting/delay": 1,
        "transport/link/tx/lease": round(settings.lease * 1e3),
        "transport/link/tx/queue/size/data": settings.router_queue if settings.mode == "router" else 2,
        "transport/shared_memory/enabled": False,
    }
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _remember(bus: ZenohBus) -> None:
    """Have the bus closed at the interpreter's exit, should its owner forget."""
    with _exit_lock:
        if not any(thread.name == EXIT_THREAD for thread in threading.enumerate()):
            threading.Thread(target=_close_at_exit, name=EXIT_THREAD, daemon=False).start()
        _open_buses.add(bus)


def _close_at_exit() -> None:
    """Close what was forgotten once the main thread is done.

    An open session keeps threads that the interpreter waits for before it calls anything registered with
    atexit, so that would be too late. And this thread is no daemon, because the interpreter must not end in
    the middle of closing.
    """
    threading.main_thread().join()
    for bus in list(_open_buses):
        bus.close()
