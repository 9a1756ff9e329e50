"""What happens in a fleet, one event after the other, as it happens."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.errors import NotConnected
from mapweave.hybridmap.map_event import MapEvent
from mapweave.wire.bus import Bus, Sample
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Scalar, decode_record
from mapweave.wire.messages import decode

IDLE = 0.5
"""Longest time after which the end of a connection is noticed, s."""


@dataclass(frozen=True)
class MapChanged:
    """The merged map has changed; also comes once at the beginning. `Fleet.refresh` fetches the map.

    Attributes:
        summary: of the map, in one line.
        settled: whether the server has merged all that came.
    """

    summary: str
    settled: bool


FleetEvent = AgentStatus | MapEvent | MapChanged
"""A robot's status, what has become of the maps, or another merged map."""


NEWS = "event", "constraints", "commands", "summary"
"""Of a server's status: where one differs, its history may have more."""


class FleetEvents:
    """Listens until it is closed; what is not read in time is replaced by what is newer."""

    def __init__(self, bus: Bus, keys: Keys, history: Callable[[], tuple[MapEvent, ...]]) -> None:
        """Begin to listen.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            history: asks the server for all events of the maps.
        """
        self._history = history
        self._changed = threading.Condition()
        self._robots: dict[str, AgentStatus] = {}
        self._servers: dict[str, dict[str, Scalar]] = {}
        self._shown: dict[str, dict[str, Scalar]] = {}
        self._known: set[MapEvent] | None = None
        with contextlib.suppress(NotConnected):  # a server may come later
            self._known = {*history()}
        self._listening = [
            bus.subscribe(keys.agent_statuses(), self._hear_robot),
            bus.subscribe(keys.server_statuses(), self._hear_server),
        ]

    def close(self) -> None:
        """Stop listening."""
        for listening in self._listening:
            listening.close()

    def until(self, end: float, over: Callable[[], bool]) -> Iterator[FleetEvent]:
        """Events in the order in which they came, until a monotonic time or until `over` says so."""
        while not over() and (left := end - time.monotonic()) > 0.0:
            with self._changed:
                self._changed.wait_for(lambda: self._robots or self._servers, min(left, IDLE))
                robots, self._robots = self._robots, {}
                servers, self._servers = self._servers, {}
            yield from robots.values()
            for key, status in servers.items():
                yield from self._of_map(key, status)

    def _of_map(self, key: str, status: dict[str, Scalar]) -> Iterator[FleetEvent]:
        """What a server's status has news of."""
        shown = self._shown.get(key, {})
        if any(shown.get(name) != status.get(name) for name in NEWS):
            try:
                history = self._history()
            except NotConnected:
                return  # its next status brings the news again
            yield from (event for event in history if self._known is not None and event not in self._known)
            self._known = {*history}
            if shown.get("summary") != status.get("summary"):
                yield MapChanged(str(status.get("summary", "")), bool(status.get("settled", False)))
        self._shown[key] = status

    def _hear_robot(self, sample: Sample) -> None:
        status = decode(sample.payload, AgentStatus)
        with self._changed:
            self._robots[status.robot] = status
            self._changed.notify()

    def _hear_server(self, sample: Sample) -> None:
        status = decode_record(sample.payload)
        with self._changed:
            self._servers[sample.key] = status
            self._changed.notify()
