"""What a bus declares in a Zenoh session, and the questions that come in."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import zenoh

from mapweave.hybridmap.errors import NotConnected
from mapweave.wire.alive_keys import AliveKeys
from mapweave.wire.bus import Reply, Request, Sample
from mapweave.wire.dispatch import Dispatcher, guarded
from mapweave.wire.keyexpr import answered, intersects
from mapweave.wire.refusal import decode_refusal, encode_refusal

log = logging.getLogger(__name__)


@dataclass
class Owner:
    """What declared things share with their bus.

    Attributes:
        dispatcher: on which handlers run. Zenoh's own threads only enqueue there.
        lock: of `declared`.
        declared: in the order of declaration.
        open_requests: questions without an answer yet.
        heard_at: when something last came from the network, s on the monotonic clock.
    """

    dispatcher: Dispatcher
    lock: threading.RLock = field(default_factory=threading.RLock)
    declared: list[Declared] = field(default_factory=list)
    open_requests: set[ZenohRequest] = field(default_factory=set)
    heard_at: float = 0.0

    def heard(self) -> None:
        """Note that something has come."""
        self.heard_at = time.monotonic()


class Declared:
    """Something declared on a bus; it is declared in Zenoh as soon as there is a session."""

    def __init__(self, owner: Owner, key: str) -> None:
        self.key = key
        self._owner = owner
        self._open = True
        self._entity: Any = None

    def declare(self, session: zenoh.Session) -> None:
        """Declare it in a session that is there now; called with the owner's lock held.

        Zenoh calls back on a Python thread, which inherits whether it is a daemon from the thread that
        declares. A daemon would be killed inside Zenoh at the interpreter's exit, and Rust answers that by
        aborting the process: so a thread that is none declares.
        """
        outcome: list[Any] = []

        def declare() -> None:
            try:
                outcome.append(self._declare_in(session))
            except (zenoh.ZError, RuntimeError) as error:
                outcome.append(error)

        ordinary = threading.Thread(target=declare, name="zenoh-declare", daemon=False)
        try:
            ordinary.start()
        except RuntimeError as error:
            # From Python 3.12 on no thread starts once the interpreter is ending; nor do those of Zenoh.
            raise NotConnected(f"{self.key}: {error}") from None
        ordinary.join()
        if isinstance(outcome[0], (zenoh.ZError, RuntimeError)):
            raise NotConnected(f"{self.key}: {outcome[0]}")
        self._entity = outcome[0]

    def _declare_in(self, session: zenoh.Session) -> Any:
        raise NotImplementedError

    def close(self) -> None:
        """Take it back. Twice is no error."""
        with self._owner.lock:
            self._open = False
            if self in self._owner.declared:
                self._owner.declared.remove(self)
            entity, self._entity = self._entity, None
        if entity is not None:
            entity.undeclare()

    def detach(self) -> None:
        """Take it back from a session that ends, to be declared in the next; with the owner's lock held."""
        entity, self._entity = self._entity, None
        if entity is not None:
            with suppress(zenoh.ZError):  # a session that has ended has taken it back
                entity.undeclare()

    def wanted(self) -> bool:
        """Whether handlers may still be called."""
        return self._open


class Token(Declared):
    """Be alive under a key."""

    def _declare_in(self, session: zenoh.Session) -> Any:
        return session.liveliness().declare_token(self.key)


class Subscription(Declared):
    """Messages to a handler, which may be called in the thread of Zenoh's callbacks."""

    def __init__(
        self, owner: Owner, key: str, handler: Callable[[Sample], None], direct: bool = False
    ) -> None:
        super().__init__(owner, key)
        self._handler, self._direct = handler, direct

    def _declare_in(self, session: zenoh.Session) -> Any:
        return session.declare_subscriber(self.key, self._receive)

    def _receive(self, sample: zenoh.Sample) -> None:
        self._owner.heard()
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
        message = Sample(str(sample.key_expr), sample.payload.to_bytes(), attachment)
        if not self._direct:
            self._owner.dispatcher.message(self._handler, message, self.wanted)
        elif self.wanted():
            guarded(lambda: self._handler(message), message.key)


class Queryable(Declared):
    """Questions under a key, or under all that a pattern matches, to the services there."""

    def __init__(self, owner: Owner, key: str) -> None:
        super().__init__(owner, key)
        # Replaced as a whole, so that Zenoh's thread reads it without the lock.
        self._services: tuple[Service, ...] = ()

    def add(self, service: Service) -> None:
        """Take in a service; called with the owner's lock held."""
        self._services += (service,)

    def remove(self, service: Service) -> None:
        """Leave a service out. Without any the key is taken back."""
        with self._owner.lock:
            self._services = tuple(one for one in self._services if one is not service)
            # From now on nothing is added to it.
            self._open = bool(self._services)
        if not self._open:
            self.close()

    def _declare_in(self, session: zenoh.Session) -> Any:
        return session.declare_queryable(self.key, self._receive)

    def _receive(self, query: zenoh.Query) -> None:
        self._owner.heard()
        asked = str(query.key_expr)
        asked_of = [one for one in self._services if intersects(asked, one.key)]
        question = _Question(query, len(asked_of))
        for service in asked_of:
            # A reply goes out on one key that the question's pattern matches.
            request = ZenohRequest(self._owner, answered(asked, service.key), question)
            self._owner.dispatcher.question(service.handler, request, service.wanted)


class Service:
    """Questions to a handler.

    Attributes:
        key: or a pattern of keys; the queryable's matches it.
        handler: what is called.
    """

    def __init__(self, queryable: Queryable, key: str, handler: Callable[[Request], None]) -> None:
        self.key, self.handler = key, handler
        self._queryable, self._open = queryable, True

    def close(self) -> None:
        """Serve no longer. Twice is no error."""
        if self._open:
            self._open = False
            self._queryable.remove(self)

    def wanted(self) -> bool:
        """Whether the handler may still be called."""
        return self._open and self._queryable.wanted()


class Watcher(Declared):
    """Who is alive, to a handler."""

    def __init__(self, owner: Owner, key: str, handler: Callable[[str, bool], None]) -> None:
        super().__init__(owner, key)
        self._alive = AliveKeys(owner.dispatcher, handler, self.wanted)

    def _declare_in(self, session: zenoh.Session) -> Any:
        return session.liveliness().declare_subscriber(self.key, self._receive, history=True)

    def detach(self) -> None:
        """Take it back; who comes again is alive again."""
        super().detach()
        self._alive.end()

    def _receive(self, sample: zenoh.Sample) -> None:
        self._owner.heard()
        # History and news may both contain the same token.
        self._alive.note(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)


class _Question:
    """A question as it came. Zenoh waits until it is dropped, when the last service is done with it."""

    def __init__(self, query: zenoh.Query, services: int) -> None:
        self.query = query
        self._open, self._lock = services, threading.Lock()
        if not services:
            self._drop()

    def done(self) -> None:
        """One of the services has answered, or never will."""
        with self._lock:
            self._open -= 1
            last = self._open == 0
        if last:
            self._drop()

    def _drop(self) -> None:
        self.query.drop()  # type: ignore[no-untyped-call]


class ZenohRequest:
    """A question to one service."""

    def __init__(self, owner: Owner, key: str, question: _Question) -> None:
        query = question.query
        self._owner = owner
        self._key = key
        self._payload = query.payload.to_bytes() if query.payload is not None else b""
        self._question = question
        self._lock = threading.Lock()
        self._answered = False
        owner.open_requests.add(self)

    @property
    def key(self) -> str:
        """The key that was asked."""
        return self._key

    @property
    def payload(self) -> bytes:
        """What was asked."""
        return self._payload

    def reply(self, payload: bytes) -> None:
        """Answer; a second answer is ignored."""
        self._finish(lambda: self._question.query.reply(self._key, payload))

    def refuse(self, reason: str, retry_after: float = 0.0) -> None:
        """Answer with an error; a second answer is ignored."""
        self._finish(lambda: self._question.query.reply_err(encode_refusal(reason, retry_after)))

    def abandon(self) -> None:
        """Mark as unanswered: the bus closes."""
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
            self._question.done()
            self._owner.open_requests.discard(self)


def read_reply(reply: zenoh.Reply) -> Reply | None:
    """A server's answer; None for Zenoh's own replies."""
    if reply.ok is not None:
        return Reply(payload=reply.ok.payload.to_bytes())
    # Zenoh's own "Timeout" is no reply: a missing answer shows in the length of the list.
    return decode_refusal(reply.err.payload.to_bytes() if reply.err is not None else b"")
