"""The merged map of a running fleet: fetched, asked about, and what becomes of it."""

import math
import threading
import time
from collections.abc import Iterator

from mapweave.connection import ANSWERED
from mapweave.fleet_events import FleetEvent, FleetEvents
from mapweave.fleet_questions import FleetQuestions
from mapweave.hybridmap.explanation import Explanation
from mapweave.hybridmap.map_event import History, MapEvent
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, View
from mapweave.map import Map
from mapweave.map_reading import MapReading
from mapweave.storage.map_file import MapFile, unpack_map_file
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, decode_explanation, encode, encode_view

PACKING = 120.0
"""How long a server may take to pack a large map, s."""
THINKING = 20.0
"""How long a server may take to find out where a view was taken, or to explain, s."""


class FleetMap(FleetQuestions, Map):
    """The part of `mapweave.fleet.Fleet` that is a map.

    It is fetched when it is first looked at, and again by `refresh`. Whereabouts, routes and explanations are
    the map server's, so they are of its newest map and need no extra here.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        """Take a connection. Nothing is fetched yet."""
        self._bus, self._keys = bus, keys
        self._lock = threading.Lock()
        self._fetched: MapReading | None = None
        self._closed = False

    def __repr__(self) -> str:
        """A short name, for example `<Fleet demo>`; asks nothing."""
        return f"<{type(self).__name__} {self._keys.fleet}>"

    def map_bytes(self) -> bytes:
        """The merged map as the bytes of a map file.

        Raises:
            NotConnected: no map server answers.
        """
        return self.map_and_bytes()[1]

    def map_and_bytes(self) -> tuple[MapFile, bytes]:
        """The content of the merged map, fetched now, and the bytes of its map file.

        Raises:
            NotConnected: no map server answers.
        """
        packed = self._packed()
        return unpack_map_file(packed), packed  # what is damaged is not handed on

    def refresh(self) -> None:
        """Fetch the merged map again: from now on it is what `nodes`, `graph`, `plot` and `export` show.

        Raises:
            NotConnected: no map server answers.
        """
        fetched = MapReading(unpack_map_file(self._packed()))
        with self._lock:
            self._fetched = fetched

    def map(self) -> MapFile:
        """The content of the merged map, fetched now; see `refresh`."""
        self.refresh()
        return self.content

    def history(self) -> tuple[MapEvent, ...]:
        """What has become of the maps, oldest first: joined, parted, kept apart and why, with dates.

        Raises:
            NotConnected: no map server answers.
        """
        return decode(self._question(self._keys.any_history(), b"", ANSWERED), History).history

    def events(self, seconds: float = math.inf) -> Iterator[FleetEvent]:
        """What happens from now on: robots' statuses, events of the maps, and another merged map.

        Of a robot whose statuses come quicker than they are read, the newest is given.

        Args:
            seconds: how long; without end if not given.
        """
        # From here on, not from when the first is read.
        return self._events(FleetEvents(self._bus, self._keys, self.history), time.monotonic() + seconds)

    def _events(self, events: FleetEvents, end: float) -> Iterator[FleetEvent]:
        try:
            yield from events.until(end, lambda: self._closed)
        finally:
            events.close()

    @property
    def _reading(self) -> MapReading:
        if self._fetched is None:
            self.refresh()
        assert self._fetched is not None, "it was fetched"
        return self._fetched

    def _packed(self) -> bytes:
        return self._question(self._keys.any_server_map(), b"", PACKING)

    def locate(self, view: View) -> RelocalizeAnswer:
        """Where a view was taken, by the newest map."""
        payload = self._question(self._keys.any_relocalize(), encode_view(view), THINKING)
        return decode(payload, RelocalizeAnswer)

    def explained(self, request: ExplainRequest) -> Explanation:
        """An explanation of the kind that the request asks for, by the newest map."""
        payload = self._question(self._keys.any_explain(), encode(request), THINKING)
        return decode_explanation(payload, request)
