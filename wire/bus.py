"""The Bus protocol: publish, subscribe, ask, serve, liveliness. The implementations are separate files."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Sample:
    """A published message.

    Attributes:
        key: under which it was published.
        payload: its content.
        attachment: what is sent beside it.
        received: when it came, of the monotonic clock, s.
    """

    key: str
    payload: bytes
    attachment: bytes = b""
    received: float = field(default_factory=time.monotonic, compare=False)


class Request(Protocol):
    """A received question. It is answered exactly once, at once or later, from any thread."""

    @property
    def key(self) -> str:
        """The key that was asked."""

    @property
    def payload(self) -> bytes:
        """What was asked."""

    def reply(self, payload: bytes) -> None:
        """Answer. A second answer is ignored."""

    def refuse(self, reason: str, retry_after: float = 0.0) -> None:
        """Answer with an error that the asker can log.

        Args:
            reason: in words.
            retry_after: seconds after which the same question may be answered; 0: to ask again does not help.
        """


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer to a question. Exactly one of payload and error is set.

    Attributes:
        payload: the answer.
        error: why there is none.
        retry_after: seconds after which a server that was only busy may answer; else 0.
    """

    payload: bytes = b""
    error: str = ""
    retry_after: float = 0.0


def never(reply: Reply) -> bool:
    """Every reply is waited for."""
    del reply
    return False


class Closing(Protocol):
    """Something declared on the bus that can be taken back."""

    def close(self) -> None:
        """Take it back. Twice is no error."""


class BusClient:
    """A part of a process that is on a bus until it is closed, by what it puts into `_closing`."""

    _closing: Sequence[Closing] = ()

    def close(self) -> None:
        """Take it all back."""
        for closing in self._closing:
            closing.close()


class Bus(Protocol):
    """A connection to the fleet.

    Handlers run one after the other on the bus's own worker thread, never on the transport's threads:
    a slow handler delays other handlers, not the transport. A handler may call any method of the bus but
    `ask` and `close`.
    """

    def publish(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        """Send best-effort; never blocks the caller, never raises for a missing connection."""

    def subscribe(self, pattern: str, handler: Callable[[Sample], None], *, direct: bool = False) -> Closing:
        """Call the handler with each message whose key the pattern (`*`, `**`) matches.

        Args:
            pattern: of keys.
            handler: what is called.
            direct: that it only passes the message on to a thread of its own, and never waits: then it may be
                called in the transport's thread, beside the other handlers. Each thread between costs more
                than the message.
        """

    def serve(self, key: str, handler: Callable[[Request], None]) -> Closing:
        """Answer questions. A handler that raises MapweaveError refuses with its text, and Busy its time."""

    def ask(
        self, key: str, payload: bytes, timeout: float, enough: Callable[[Reply], bool] = never
    ) -> list[Reply]:
        """Ask everyone who serves the key; waits until all have answered or the time is over.

        Args:
            key: or a pattern.
            payload: the question.
            timeout: longest wait, s.
            enough: whether a reply ends the wait for others; called in the asking thread with each.

        Returns:
            The replies. An empty list means that there is no server.
        """

    def announce(self, key: str) -> Closing:
        """Be alive under this key until closed or dead."""

    def watch(self, pattern: str, handler: Callable[[str, bool], None]) -> Closing:
        """Call the handler with (key, alive) for those alive now and at each change."""

    @property
    def dropped(self) -> int:
        """Messages and questions for which the queue of the handlers had no room, since the start."""

    def connected(self) -> bool:
        """Whether messages can leave now. Always true on an in-memory bus."""

    def close(self) -> None:
        """Take everything back and disconnect. Twice is no error."""
