"""The bus over Zenoh. Only this file and zenoh_entities import zenoh.

An agent is a client of a router; the map server's session is that router. A client opens in a thread of its
own, since opening without a router fails: constructing a bus never blocks and a missing router is no error.
From the first connection on Zenoh itself reconnects and declares again.
"""

import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar

import zenoh

from mapweave.hybridmap.errors import NotConnected
from mapweave.wire import exit_closing
from mapweave.wire.bus import Closing, Reply, Request, Sample, never
from mapweave.wire.bus_settings import QUEUE_LIMIT, RETRY_FIRST, RETRY_LONGEST, BusSettings
from mapweave.wire.credentials import Credentials
from mapweave.wire.dispatch import Dispatcher, failures
from mapweave.wire.keyexpr import check_key, check_pattern
from mapweave.wire.keys import questions_to_robot
from mapweave.wire.open_files import allow_many_files
from mapweave.wire.publishers import Publishers
from mapweave.wire.zenoh_config import session_values
from mapweave.wire.zenoh_entities import (
    Declared,
    Owner,
    Queryable,
    Service,
    Subscription,
    Token,
    Watcher,
    read_reply,
)

log = logging.getLogger(__name__)

_D = TypeVar("_D", bound=Declared)
SILENT, UNANSWERED = 20.0, 10.0
"""After so long without any message a client asks its router for a sign of life, and connects again if none
comes for so long, s. A router that is gone is noticed earlier, by Zenoh."""
MOST_REPLIES, MOST_REPLY_BYTES = 16_384, 2**27
"""To one question; then no further one is waited for: one of each client that a router takes, and four of the
largest size. Zenoh lets each client send any number of them."""
ENDED = 0.5
"""s in which a session ends; with clients that all read it takes 0.1."""
FIRST_LOOK = 0.05
"""When a client first looks for that sign, s; later ones each take twice the time of the one before."""


class ZenohBus:
    """A connection to the fleet over Zenoh. Close it: an open session can hang the interpreter's exit.

    Attributes:
        owner: what is declared shares this with the bus.
    """

    def __init__(self, settings: BusSettings | None = None) -> None:
        """Connect, or begin to.

        Args:
            settings: a client of the default router if not given.

        Raises:
            NotConnected: a router cannot listen where it should, for example since the port is taken.
        """
        self._settings = settings or BusSettings()
        self._closed, self._woken = threading.Event(), threading.Event()
        self._session: zenoh.Session | None = None
        self._in_use = 0
        self._in_use_changed = threading.Condition()
        self._connecting = threading.Thread(target=self._keep_connected, name="zenoh-connect", daemon=True)
        self._links: list[object] = []
        self._publishers = Publishers()
        self._queryables: dict[str, Queryable] = {}
        if self._settings.mode == "router":
            self._session = _open_router(self._settings)
            self._watch_links(self._session)
        self.owner = Owner(Dispatcher(f"zenoh-{self._settings.mode}", QUEUE_LIMIT))
        exit_closing.remember(self)
        if self._session is None:
            self._connecting.start()

    def publish(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        """Send best-effort. Without a connection the message is lost."""
        check_key(key)
        with self.using_session() as session:
            if session is None:
                return
            try:
                self._publishers.of(session, key).put(payload, attachment=attachment or None)
            except zenoh.ZError:
                # The session was closed between the check and the put: the same as no connection.
                log.debug("put on %s after the session was closed", key)

    def subscribe(self, pattern: str, handler: Callable[[Sample], None], *, direct: bool = False) -> Closing:
        """Call the handler with each matching message."""
        return self.declare(Subscription(self.owner, check_pattern(pattern), handler, direct))

    def serve(self, key: str, handler: Callable[[Request], None]) -> Closing:
        """Answer questions."""
        to_robot = questions_to_robot(check_pattern(key))
        with self.owner.lock:
            queryable = self._queryables.get(to_robot)
            if new := queryable is None or not queryable.wanted():
                queryable = Queryable(self.owner, to_robot or key)
            service = Service(queryable, key, handler)
            queryable.add(service)
            if new:
                self.declare(queryable)
            if to_robot:
                self._queryables[to_robot] = queryable
        return service

    def ask(
        self, key: str, payload: bytes, timeout: float, enough: Callable[[Reply], bool] = never
    ) -> list[Reply]:
        """Ask everyone who serves the key (or a key that the pattern matches)."""
        check_pattern(key)
        replies: list[Reply] = []
        size = 0
        with self.using_session() as session:
            if session is None:
                return []
            try:
                # Every server is asked and every answer kept: the default consolidation holds a quick answer
                # back until the slowest server's, and takes two answers on one key for one.
                for one in session.get(
                    key,
                    payload=payload,
                    timeout=timeout,
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                ):
                    if (reply := read_reply(one)) is not None:
                        self.owner.heard()
                        replies.append(reply)
                        size += len(reply.payload)
                        if enough(reply):
                            break
                        if len(replies) >= MOST_REPLIES or size >= MOST_REPLY_BYTES:
                            if (also := failures.count(key)) is not None:
                                words = "%s: too many replies (%d, %d bytes)%s"
                                log.warning(words, key, len(replies), size, also)
                            break
            except zenoh.ZError as error:
                log.debug("asking %s failed: %s", key, error)
        return replies

    def announce(self, key: str) -> Closing:
        """Be alive under this key."""
        return self.declare(Token(self.owner, check_key(key)))

    def watch(self, pattern: str, handler: Callable[[str, bool], None]) -> Closing:
        """Call the handler with who is alive, now and at each change."""
        return self.declare(Watcher(self.owner, check_pattern(pattern), handler))

    @property
    def closed(self) -> bool:
        """Whether it was closed; it does not connect again."""
        return self._closed.is_set()

    @property
    def dropped(self) -> int:
        """What found the queue of the handlers full."""
        return self.owner.dispatcher.dropped

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

    def reopen(self, settings: BusSettings) -> None:
        """Open a router again with other settings, for example other access rules, which Zenoh reads once.

        Its clients connect again by themselves. What is published meanwhile is lost, as without a connection.

        Raises:
            NotConnected: it cannot listen now, or is closed. Until it is opened again it has no connection.
        """
        with self.owner.lock:
            if self._closed.is_set():
                raise NotConnected("this bus is closed")
            session = _open_router(settings, self._close_session())
            try:
                for entity in self.owner.declared:
                    entity.declare(session)
            except BaseException:
                session.close()  # type: ignore[no-untyped-call]
                raise
            self._settings, self._session = settings, session
            self._watch_links(session)

    def renew(self, credentials: Credentials) -> None:
        """Let a client connect again with another key: Zenoh reads it once."""
        with self.owner.lock:
            if not self._closed.is_set():
                self._settings = replace(self._settings, credentials=credentials)
                self._close_session()
        self._woken.set()

    def close(self) -> None:
        """Take everything back and disconnect."""
        with self.owner.lock:
            if self._closed.is_set():
                return
            self._closed.set()
            self._woken.set()
            session, self._session = self._session, None
            declared, self.owner.declared = self.owner.declared, []
        if self._connecting.is_alive():
            self._connecting.join()
        self.owner.dispatcher.close()
        for request in list(self.owner.open_requests):
            request.abandon()
        for entity in declared:
            entity.close()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        with self._in_use_changed:
            self._in_use_changed.wait_for(lambda: self._in_use == 0)
        exit_closing.forget(self)

    @contextmanager
    def using_session(self) -> Iterator[zenoh.Session | None]:
        """The session, if there is one; `close` waits until its users are done.

        The interpreter kills a daemon thread that it finds inside Zenoh at its exit, and Rust answers that by
        aborting the process.
        """
        with self._in_use_changed:
            session = self._session
            self._in_use += session is not None
        try:
            yield session
        finally:
            if session is not None:
                with self._in_use_changed:
                    self._in_use -= 1
                    self._in_use_changed.notify_all()

    def declare(self, declared: _D) -> _D:
        """Declare something now, or once there is a session.

        Raises:
            NotConnected: the bus is closed.
        """
        with self.owner.lock:
            if self._closed.is_set():
                raise NotConnected("this bus is closed")
            self.owner.declared.append(declared)
            if self._session is not None:
                declared.declare(self._session)
        return declared

    def _close_session(self) -> threading.Thread | None:
        """Take everything back from the session, to be declared in the next; with the owner's lock held.

        Returns:
            What still ends the session, if that takes long: a client that has stopped reading, with a large
            answer on its way, holds it up for up to 20 s. The port is free by then.
        """
        session, self._session = self._session, None
        for entity in self.owner.declared:
            entity.detach()
        with self._in_use_changed:
            self._in_use_changed.wait_for(lambda: self._in_use == 0)
        self._publishers = Publishers()
        if session is None:
            return None
        # Not a daemon, which the interpreter would kill inside Zenoh at its exit.
        ending = threading.Thread(target=_end, args=(session,), name="zenoh-end", daemon=False)
        ending.start()
        ending.join(ENDED)
        return ending if ending.is_alive() else None

    def _watch_links(self, session: zenoh.Session) -> None:
        """Log who connects, and who is denied everything."""
        access = self._settings.access
        if access is None:
            return
        members = {member.subject: member for member in access.members}
        revoked = dict(access.revoked)
        known: set[str] = set()
        certified = self._settings.credentials is not None and self._settings.credentials.certified

        def report(event: zenoh.LinkEvent) -> None:
            subject, where = event.link.auth_identifier or "a client", str(event.link.dst)
            if event.kind == zenoh.SampleKind.DELETE:
                known.discard(where)
                log.info("%s at %s disconnects", subject, where)
                return
            if where in known:
                return
            known.add(where)
            if not certified:
                # Zenoh has checked the password, and does not say whose it was.
                log.info("%s connects from %s", subject, where)
            elif subject in members:
                log.info("%s %s connects from %s", members[subject].role, members[subject].name, where)
            elif subject in revoked:
                log.warning("refused: %s at %s: this key was revoked %s", subject, where, revoked[subject])
            else:
                log.warning("refused: %s at %s: no identity of this fleet", subject, where)

        self._links = [session.info.declare_link_events_listener(report)]

    def _keep_connected(self) -> None:
        """Connect, and again whenever the router keeps the connection and has forgotten who is behind it.

        With Zenoh 1.10 that happens when a busy router breaks off a handshake at its end, because it took
        longer than `ACCEPT_TIMEOUT`: the link lives, and nothing that the client declares or sends is heard.
        """
        self._connect()
        while not self._closed.is_set():
            self._woken.wait(max(SILENT / 10, self.owner.heard_at + SILENT - time.monotonic()))
            self._woken.clear()
            session = self._session
            if session is None:
                self._connect()
                continue
            if time.monotonic() - self.owner.heard_at < SILENT or not self.connected():
                continue
            if self._is_answered(session):
                self.owner.heard()
            elif not self._closed.is_set() and self.connected():
                log.warning("the router keeps the connection and answers nothing: connecting again")
                with self.owner.lock:
                    if not self._closed.is_set():
                        self._close_session()
                self._connect()

    def _is_answered(self, session: zenoh.Session) -> bool:
        """Whether the router says who is alive; only what this client watches is it allowed to ask."""
        with self.owner.lock:
            watched = next((one.key for one in self.owner.declared if isinstance(one, Watcher)), None)
        if watched is None:
            return True
        end = time.monotonic() + UNANSWERED
        pause = FIRST_LOOK
        try:
            # A client itself answers with what it knows; only the router's word ends that before its time,
            # which is behind the last look. What is said does not matter, and there may be more of it than
            # Zenoh's default channel holds: a full one blocks the thread that asks.
            answers = session.liveliness().get(
                watched, handler=zenoh.handlers.RingChannel(1), timeout=2 * UNANSWERED
            )
            while not self._closed.wait(pause):
                # A busy router leaves all of its clients waiting at once: looks must not make it busier.
                pause = min(2 * pause, UNANSWERED / 10)
                answers.try_recv()
                if time.monotonic() >= end:
                    return False
        except zenoh.ZError:
            log.debug("the router has said who is alive under %s", watched)
        return True

    def _connect(self) -> None:
        """Try until there is a router, then declare what was asked for in the meantime."""
        wait = RETRY_FIRST
        reported = False
        while not self._closed.is_set():
            settings = self._settings
            try:
                session = zenoh.open(_config(settings))
            except zenoh.ZError as error:
                if not reported:
                    log.info("no router at %s yet, trying on", ", ".join(self._settings.endpoints))
                    log.debug("zenoh says: %s", error)
                    reported = True
                self._closed.wait(wait)
                wait = min(2 * wait, RETRY_LONGEST)
                continue
            with self.owner.lock:
                if not self._closed.is_set() and settings is self._settings:
                    try:
                        for declared in self.owner.declared:
                            declared.declare(session)
                        self._session = session
                        self.owner.heard()
                        return
                    except NotConnected as error:
                        if threading.main_thread().is_alive():
                            log.warning("connected, and then: %s; trying again", error)
                        for declared in self.owner.declared:
                            declared.detach()
            _end(session)
            # While the interpreter is ending no caller waits for this bus.
            if not threading.main_thread().is_alive():
                return
            self._closed.wait(RETRY_LONGEST)


def _end(session: zenoh.Session) -> None:
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        log.debug("closing a session: %s", error)


def _open_router(settings: BusSettings, ending: threading.Thread | None = None) -> zenoh.Session:
    """Open it, if need be once a session before has left the port.

    Raises:
        NotConnected: it cannot listen where it should.
    """
    allow_many_files()
    config = _config(settings)
    while ending is not None and ending.is_alive():
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            ending.join(ENDED)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(settings.listen)
        if "in use" in str(error):
            raise NotConnected(
                f"cannot listen at {where}: the port is taken; stop the other server or choose another port"
            ) from None
        raise NotConnected(f"cannot listen at {where}: {str(error).split(' at /')[0]}") from None


def _config(settings: BusSettings) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in session_values(settings).items():
        config.insert_json5(path, json.dumps(value))
    return config
