"""A map server that starts before its database, as both do after a power cut, waits for it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from mapweave.hybridmap.errors import StoreAway
from mapweave.processes.service_manager import ServiceManager

Made = TypeVar("Made")

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
