"""What an in-memory bus declares on its hub, and the questions on their way."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from mapweave.wire.alive_keys import AliveKeys
from mapweave.wire.bus import Reply, Request, Sample
from mapweave.wire.dispatch import Dispatcher
from mapweave.wire.refusal import decode_refusal, encode_refusal

Given = TypeVar("Given")


class Declared:
    """Something that a bus has on the hub until it is closed."""

    def __init__(self, key: str, dispatcher: Dispatcher, remove: Callable[[Declared], None]) -> None:
        self.key = key
        self.open = True
        self._dispatcher = dispatcher
        self._remove = remove

    def close(self) -> None:
        """Take it back. Twice is no error."""
        self.open = False
        self._remove(self)

    def wanted(self) -> bool:
        """Whether the handler may still be called."""
        return self.open


class Token(Declared):
    """Be alive under a key."""


class _Handled(Declared, Generic[Given]):
    """Something that a handler is called with."""

    def __init__(
        self,
        key: str,
        dispatcher: Dispatcher,
        remove: Callable[[Declared], None],
        handler: Callable[[Given], None],
    ) -> None:
        super().__init__(key, dispatcher, remove)
        self._handler = handler


class Subscription(_Handled[Sample]):
    """Messages to a handler."""

    def deliver(self, sample: Sample) -> None:
        """A message has come."""
        self._dispatcher.message(self._handler, sample, self.wanted)


class Service(_Handled[Request]):
    """Questions to a handler."""

    def deliver(self, request: MemoryRequest) -> None:
        """A question has come."""
        self._dispatcher.question(self._handler, request, self.wanted)


class Watcher(Declared):
    """Who is alive, to a handler."""

    def __init__(
        self,
        key: str,
        dispatcher: Dispatcher,
        remove: Callable[[Declared], None],
        handler: Callable[[str, bool], None],
    ) -> None:
        super().__init__(key, dispatcher, remove)
        self._alive = AliveKeys(dispatcher, handler, self.wanted)
        self._seen: set[str] = set()

    def see(self, alive: set[str]) -> None:
        """Report the differences from the last report."""
        for key in sorted(self._seen - alive):
            self._alive.note(key, False)
        for key in sorted(alive - self._seen):
            self._alive.note(key, True)
        self._seen = alive


class MemoryRequest:
    """A question on its way to one service."""

    def __init__(
        self, key: str, payload: bytes, finish: Callable[[MemoryRequest, Reply | None], None]
    ) -> None:
        """Take the question, and who passes the reply on; a second reply is ignored there."""
        self._key = key
        self._payload = payload
        self._finish = finish

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
        self._finish(self, Reply(payload=bytes(payload)))

    def refuse(self, reason: str, retry_after: float = 0.0) -> None:
        """Answer with an error; a second answer is ignored."""
        self._finish(self, decode_refusal(encode_refusal(reason, retry_after)))

    def abandon(self) -> None:
        """Mark as unanswered: the server has closed."""
        self._finish(self, None)


class Collector:
    """Gathers the replies to one question until none is missing."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._missing = 0
        self._replies: list[Reply] = []

    def expect(self) -> None:
        """One more will answer."""
        with self._changed:
            self._missing += 1

    def add(self, reply: Reply | None) -> None:
        """One has answered, or never will."""
        with self._changed:
            self._missing -= 1
            if reply is not None:
                self._replies.append(reply)
            self._changed.notify_all()

    def end(self) -> None:
        """Stop waiting for replies."""
        with self._changed:
            self._missing = 0
            self._changed.notify_all()

    def wait(self, timeout: float, enough: Callable[[Reply], bool]) -> list[Reply]:
        """The answers, as soon as one is enough, none is missing or the time is over."""
        end = time.monotonic() + timeout
        seen = 0
        while True:
            with self._changed:
                while (
                    seen == len(self._replies) and self._missing > 0 and (left := end - time.monotonic()) > 0
                ):
                    self._changed.wait(left)
                if seen == len(self._replies):
                    return list(self._replies)
                reply = self._replies[seen]
                seen += 1
            if enough(reply):
                return self._replies[:seen]
