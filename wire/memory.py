"""A fleet inside one process: for tests, and for demonstrations without a network."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mapweave.hybridmap.errors import NotConnected
from mapweave.wire.bus import Closing, Reply, Request, Sample, never
from mapweave.wire.dispatch import Dispatcher
from mapweave.wire.keyexpr import answered, check_key, check_pattern, intersects
from mapweave.wire.memory_entities import (
    Collector,
    Declared,
    MemoryRequest,
    Service,
    Subscription,
    Token,
    Watcher,
)

_D = TypeVar("_D", bound=Declared)


@dataclass(frozen=True, slots=True)
class MessageFaults:
    """What goes wrong with published messages; questions and liveliness are not touched.

    Attributes:
        drop: share that is lost, 0 to 1.
        double: share that comes twice.
        delay: share that is held back.
        longest_delay: for how many later messages a held one may wait at most.
    """

    drop: float = 0.0
    double: float = 0.0
    delay: float = 0.0
    longest_delay: int = 8


class MemoryHub:
    """What a router is to Zenoh: the place where buses meet."""

    def __init__(self) -> None:
        """Make an empty hub without losses."""
        self._lock = threading.RLock()
        self._buses: list[MemoryBus] = []
        self._faults: dict[MemoryBus | None, MessageFaults] = {}
        self._random = np.random.default_rng(0)
        self._held: list[tuple[int, MemoryBus, Sample]] = []
        self._clock = 0

    def disturb(
        self, faults: MessageFaults, random: np.random.Generator, bus: MemoryBus | None = None
    ) -> None:
        """Disturb messages from now on, with the given random numbers: of one bus, or of all."""
        with self._lock:
            self._faults[bus] = faults
            self._random = random

    def calm(self, bus: MemoryBus | None = None) -> None:
        """Deliver messages of one bus, or of all, from now on; those held back arrive, oldest last."""
        with self._lock:
            if bus is None:
                self._faults.clear()
            else:
                self._faults.pop(bus, None)
            held = [entry for entry in self._held if bus in (None, entry[1])]
            self._held = [entry for entry in self._held if bus not in (None, entry[1])]
            for _, sender, sample in reversed(held):
                self._deliver(sender, sample)

    def cut(self, bus: MemoryBus) -> None:
        """Disconnect a bus from the hub: it sends and receives nothing, and its tokens disappear."""
        self._change(lambda: setattr(bus, "_cut", True))

    def restore(self, bus: MemoryBus) -> None:
        """Put a cut bus back."""
        self._change(lambda: setattr(bus, "_cut", False))

    # What the buses use.

    def _join(self, bus: MemoryBus) -> None:
        with self._lock:
            self._buses.append(bus)

    def _leave(self, bus: MemoryBus) -> None:
        with self._lock:
            if bus in self._buses:
                self._change(lambda: self._buses.remove(bus))

    def _change(self, change: Callable[[], object]) -> None:
        """Make a change that may alter visibility, and notify the watchers."""
        with self._lock:
            change()
            tokens = [(bus, token.key) for bus in self._buses for token in bus._tokens]
            for bus in self._buses:
                alive = {key for owner, key in tokens if not owner._cut and not bus._cut}
                for watcher in list(bus._watchers):
                    watcher.see({key for key in alive if intersects(watcher.key, key)})

    def _publish(self, sender: MemoryBus, sample: Sample) -> None:
        with self._lock:
            if sender._cut:
                return
            self._clock += 1
            faults = self._faults.get(sender) or self._faults.get(None) or MessageFaults()
            if self._random.random() >= faults.drop:
                for _ in range(2 if self._random.random() < faults.double else 1):
                    if self._random.random() < faults.delay:
                        due = self._clock + int(self._random.integers(1, faults.longest_delay + 1))
                        self._held.append((due, sender, sample))
                    else:
                        self._deliver(sender, sample)
            ripe = [held for held in self._held if held[0] <= self._clock]
            self._held = [held for held in self._held if held[0] > self._clock]
            for _, late_sender, late in ripe:
                self._deliver(late_sender, late)

    def _deliver(self, sender: MemoryBus, sample: Sample) -> None:
        if sender._cut:
            return
        for bus in self._buses:
            for subscription in list(bus._subscriptions):
                if not bus._cut and intersects(subscription.key, sample.key):
                    subscription.deliver(sample)

    def _ask(self, asker: MemoryBus, key: str, payload: bytes, collector: Collector) -> None:
        with self._lock:
            if asker._cut:
                return
            for bus in self._buses:
                for service in list(bus._services):
                    if not bus._cut and intersects(service.key, key):
                        asked = answered(key, service.key)
                        service.deliver(bus._opened(asked, payload, asker, collector))


class MemoryBus:
    """One participant's connection to a hub."""

    _numbers = itertools.count(1)

    def __init__(self, hub: MemoryHub) -> None:
        """Join the hub."""
        self._hub = hub
        self._cut = False
        self._closed = False
        self._subscriptions: list[Subscription] = []
        self._services: list[Service] = []
        self._tokens: list[Token] = []
        self._watchers: list[Watcher] = []
        self._open_questions: set[Collector] = set()
        self._open_requests: set[MemoryRequest] = set()
        self._dispatcher = Dispatcher(f"memory-bus-{next(self._numbers)}")
        hub._join(self)

    def publish(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        """Send to all who subscribe, if this bus is on the hub."""
        check_key(key)
        if not self._closed:
            self._hub._publish(self, Sample(key, bytes(payload), bytes(attachment)))

    def subscribe(self, pattern: str, handler: Callable[[Sample], None], *, direct: bool = False) -> Closing:
        """Call the handler with each matching message."""
        del direct  # all have one thread
        declared = Subscription(check_pattern(pattern), self._dispatcher, self._remove, handler)
        return self._add(self._subscriptions, declared)

    def serve(self, key: str, handler: Callable[[Request], None]) -> Closing:
        """Answer questions."""
        declared = Service(check_pattern(key), self._dispatcher, self._remove, handler)
        return self._add(self._services, declared)

    def ask(
        self, key: str, payload: bytes, timeout: float, enough: Callable[[Reply], bool] = never
    ) -> list[Reply]:
        """Ask everyone who serves the key (or a key that the pattern matches)."""
        check_pattern(key)
        collector = Collector()
        self._open_questions.add(collector)
        if not self._closed:
            self._hub._ask(self, key, bytes(payload), collector)
        try:
            return collector.wait(timeout, enough)
        finally:
            self._open_questions.discard(collector)

    def announce(self, key: str) -> Closing:
        """Be alive under this key."""
        return self._add(self._tokens, Token(check_key(key), self._dispatcher, self._remove))

    def watch(self, pattern: str, handler: Callable[[str, bool], None]) -> Closing:
        """Call the handler with who is alive, now and at each change."""
        declared = Watcher(check_pattern(pattern), self._dispatcher, self._remove, handler)
        return self._add(self._watchers, declared)

    @property
    def dropped(self) -> int:
        """What found the queue of the handlers full."""
        return self._dispatcher.dropped

    def connected(self) -> bool:
        """True unless the hub has cut this bus or it is closed."""
        return not (self._cut or self._closed)

    def wait_connected(self, timeout: float) -> bool:
        """The same: nothing to wait for."""
        return self.connected()

    def close(self) -> None:
        """Leave the hub."""
        if self._closed:
            return
        self._closed = True
        self._hub._leave(self)
        self._dispatcher.close()
        with self._hub._lock:
            abandoned = list(self._open_requests)
        for question in list(self._open_questions):
            question.end()
        for request in abandoned:
            request.abandon()

    def _opened(self, key: str, payload: bytes, asker: MemoryBus, collector: Collector) -> MemoryRequest:
        """A question to a service of this bus. The hub is locked."""

        def finish(request: MemoryRequest, reply: Reply | None) -> None:
            with self._hub._lock:
                if request not in self._open_requests:
                    return
                self._open_requests.discard(request)
                lost = self._cut or asker._cut
            collector.add(None if lost else reply)

        request = MemoryRequest(key, payload, finish)
        collector.expect()
        self._open_requests.add(request)
        return request

    def _add(self, declared_of_kind: list[_D], declared: _D) -> _D:
        if self._closed:
            raise NotConnected("this bus is closed")
        self._hub._change(lambda: declared_of_kind.append(declared))
        return declared

    def _remove(self, declared: Declared) -> None:
        def remove() -> None:
            everything: tuple[list[Declared], ...] = (
                self._subscriptions,  # type: ignore[assignment]
                self._services,
                self._tokens,
                self._watchers,
            )
            for kind in everything:
                if declared in kind:
                    kind.remove(declared)

        self._hub._change(remove)
