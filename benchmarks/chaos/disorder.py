"""Messages that come twice, late and so in another order: at a robot's link, and as a listener hears them."""

import heapq
import threading
import time
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import MapId
from mapweave.wire.bus import Bus, Closing, Sample
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Mark
from mapweave.wire.zenoh_bus import ZenohBus

DOUBLED, LATE = 0.3, 0.3
"""Shares of the messages that come a second time, late, and that come only late."""
SHORTEST, LONGEST = 0.02, 8.0
"""What late is, s; the logarithm is even. A server is killed and back within the longest."""


def flag(folder: Path, name: str) -> Path:
    """The file with which the messages of an agent or a server are doubled and late."""
    return folder / f"{name}.disorder"


class DisorderedBus:
    """A robot's link that sends and hands on some messages twice, and some late, while a file is there.

    What the robot publishes goes by its own file, what servers have published by theirs. Questions and
    answers stay as they are: Zenoh pairs them itself.
    """

    def __init__(self, bus: Bus, folder: Path, seed: Sequence[int]) -> None:
        """Pass everything on, until there is a file.

        Args:
            bus: the link; stays the caller's.
            folder: of the files.
            seed: of what is doubled and what is late.
        """
        self._bus, self._folder = bus, folder
        self._rng = np.random.default_rng(seed)
        self._changed = threading.Condition()
        self._number = count()
        self._late: list[tuple[float, int, Callable[[], None]]] = []
        self._closed = False
        self._thread = threading.Thread(target=self._send_late, name="late messages", daemon=True)
        self._thread.start()

    def publish(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        """Send, perhaps twice or later. Without a connection nothing leaves, and nothing comes later."""
        if not self._bus.connected():
            return
        self._pass_on(key, lambda: self._bus.publish(key, payload, attachment))

    def subscribe(self, pattern: str, handler: Callable[[Sample], None], *, direct: bool = False) -> Closing:
        """Listen; the handler is called from another thread with what is late."""
        return self._bus.subscribe(
            pattern, lambda sample: self._pass_on(sample.key, lambda: handler(sample)), direct=direct
        )

    def close(self) -> None:
        """Forget what is late. The link stays open."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def __getattr__(self, name: str) -> Any:
        """All else is the link's."""
        return getattr(self._bus, name)

    def _pass_on(self, key: str, send: Callable[[], None]) -> None:
        # mapweave/1/<fleet>/agent/<agent>/..., or server/<server>.
        if flag(self._folder, key.split("/")[4]).exists():
            with self._changed:
                draw = self._rng.random()
                delay = SHORTEST * (LONGEST / SHORTEST) ** self._rng.random()
                if draw < DOUBLED + LATE:
                    heapq.heappush(self._late, (time.monotonic() + delay, next(self._number), send))
                    self._changed.notify()
            if DOUBLED <= draw < DOUBLED + LATE:
                return
        send()

    def _send_late(self) -> None:
        while True:
            with self._changed:
                while not self._closed and (not self._late or self._late[0][0] > time.monotonic()):
                    self._changed.wait(self._late[0][0] - time.monotonic() if self._late else None)
                if self._closed:
                    return
                _, _, send = heapq.heappop(self._late)
            send()


class ChangeListener:
    """Hears the changes of all robots, as servers do.

    Attributes:
        doubled: changes that had come before.
        reordered: changes that came for the first time behind a later one of their log.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        """Listen; the bus stays the caller's."""
        self.doubled = self.reordered = 0
        self._keys = keys
        self._heard: dict[tuple[MapId, int], set[int]] = {}
        self._newest: dict[tuple[MapId, int], int] = {}
        self._subscription = bus.subscribe(keys.changes(), self._hear)

    def close(self) -> None:
        """Listen no more."""
        self._subscription.close()

    def _hear(self, sample: Sample) -> None:
        try:
            mark = Mark.decode(sample.attachment)
        except InvalidMessage:
            return
        log = self._keys.parse_change(sample.key), mark.log_id
        heard, newest = self._heard.setdefault(log, set()), self._newest.get(log, 0)
        if mark.sequence in heard:
            self.doubled += 1
        elif mark.sequence < newest:
            self.reordered += 1
        heard.add(mark.sequence)
        self._newest[log] = max(newest, mark.sequence)


class RouterListener:
    """A ChangeListener with a link of its own. A context manager."""

    def __init__(self, endpoints: Sequence[str], fleet: str) -> None:
        """Connect to the routers of a fleet."""
        self._bus = ZenohBus(BusSettings(endpoints=tuple(endpoints)))
        self.heard = ChangeListener(self._bus, Keys(fleet))

    def __enter__(self) -> ChangeListener:
        """What it hears."""
        return self.heard

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self.heard.close()
        self._bus.close()
