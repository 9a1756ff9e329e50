"""A map server that starts before its database, as both do after a power cut, waits for it."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import TypeVar

from mapweave.hybridmap.errors import StoreAway
from mapweave.processes.service_manager import ServiceManager
from mapweave.wire.bus import Bus, Closing, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import encode_record

Made = TypeVar("Made")

VERSION = version("mapweave")

EVERY = 1.0
"""s between two attempts."""


@dataclass(frozen=True)
class Waiting:
    """Who hears of a wait.

    Attributes:
        log: gets a line when the wait begins, and one when it has ended.
        show: gets what is waited for at present; nothing once it has come.
    """

    log: Callable[[str], None]
    show: Callable[[str], None]


class WaitingServer:
    """Answers for a server that waits, to who asks for the status of servers, and to no other question.

    It is not announced: robots count on those that are.
    """

    def __init__(self, bus: Bus, keys: Keys, name: str) -> None:
        """Nothing is waited for yet."""
        self._bus, self._keys, self._name = bus, keys, name
        self._words, self._serving = "", list[Closing]()

    def show(self, words: str) -> None:
        """What is waited for at present; nothing once it has come."""
        self._words = words
        if words and not self._serving:
            self._serving.append(self._bus.serve(self._keys.server_status(self._name), self._answer))
        if not words:
            self.close()

    def close(self) -> None:
        """Answer no more. Idempotent."""
        while self._serving:
            self._serving.pop().close()

    def _answer(self, request: Request) -> None:
        words = self._words
        request.reply(encode_record({
            "name": self._name, "summary": words, "event": words, "loading": True, "settled": False,
            "version": VERSION,
        }))  # fmt: skip


def made_with_store(
    make: Callable[[], Made],
    may_help: Callable[[], bool],
    waiting: Waiting,
    stop: threading.Event,
    longest: float,
) -> Made | None:
    """Make what needs a store, and try again until the store is there; None if stopped meanwhile.

    Args:
        make: fails with StoreAway where the store is not there.
        may_help: whether waiting may help; asked after the first failure, and after one with other words.
        waiting: who hears of a wait.
        stop: ends the wait.
        longest: of the wait, s.

    Raises:
        StoreAway: waiting does not help, or has not helped.
    """
    manager, began, reason = ServiceManager(), time.monotonic(), ""
    while not stop.is_set():
        try:
            made = make()
        except StoreAway as error:
            if time.monotonic() >= began + longest or (str(error) != reason and not may_help()):
                raise
            if not reason:
                waiting.log(f"waiting for at most {longest:g} s: {error}")
            reason = str(error)
            waiting.show(f"waiting: {reason}")
            manager.starts(reason)
            stop.wait(EVERY)
        else:
            if reason:
                waiting.log(f"the map store is there, after {time.monotonic() - began:.0f} s")
                waiting.show("")
            return made
    return None
