"""The merged map of a running fleet: fetched, asked about, annotated and corrected."""

import hashlib
import math
import threading
import time
from collections.abc import Iterable, Iterator

from mapweave.connection import ANSWERED
from mapweave.editable_map import EditableMap
from mapweave.fleet_events import FleetEvent, FleetEvents
from mapweave.fleet_questions import FleetQuestions
from mapweave.hybridmap.annotation import Annotation, AnnotationRequest, Annotations
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.explanation import Explanation
from mapweave.hybridmap.floor_plan import PIECE, PlacedPlans, PlanImage, PlanPiece, PlanReceived
from mapweave.hybridmap.manual_constraint import ConstraintList, ConstraintRequest, ManualConstraint
from mapweave.hybridmap.map_event import History, MapEvent
from mapweave.hybridmap.named_nodes import NodeWord, asked_of
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, ResolveAnswer, ResolveRequest, View
from mapweave.map_reading import MapReading
from mapweave.storage.map_file import MapFile, unpack_map_file
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode, decode_explanation, encode, encode_view
from mapweave.wire.senders import sent_by

PACKING = 120.0
"""How long a server may take to pack a large map, s."""
ANSWER = 10.0
"""A server that merges answers questions about its map late, s."""
CHECKING = 20.0
"""How long a server may take to check a manual constraint against a large map, s."""
THINKING = 20.0
"""How long a server may take to find out where a view was taken, or to explain, s."""


class FleetMap(FleetQuestions, EditableMap):
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

    def annotations(self) -> Annotations:
        """What people say about the map.

        Raises:
            NotConnected: no map server answers.
        """
        return decode(self._question(self._keys.any_annotations(), b"", ANSWER), Annotations)

    def resolve(self, request: ResolveRequest | NodeWord | Iterable[NodeWord]) -> ResolveAnswer:
        """Nodes for words: names of places, and positions in the merged map.

        Raises:
            InvalidValue: it is no text.
            Refused: a word is none, with the reason.
            NotConnected: no map server answers.
        """
        payload = encode(asked_of(request))
        return decode(self._question(self._keys.any_resolve(), payload, ANSWER), ResolveAnswer)

    def plans(self) -> PlacedPlans:
        """Floor plans, and where they lie under the merged map.

        Raises:
            NotConnected: no map server answers.
        """
        return decode(self._question(self._keys.any_plans(), b"", ANSWER), PlacedPlans)

    def plan_image(self, sha256: str) -> bytes:
        """The PNG file of a plan, by the name of its image.

        Raises:
            Refused: the server does not have it.
            NotConnected: no map server answers.
        """
        return self._question(self._keys.any_plan_image(), sha256.encode(), ANSWER)

    def put_plan_image(self, png: bytes) -> PlanImage:
        """Send the image of a plan, a PNG file, before the annotation that names it.

        Raises:
            InvalidValue: it is no PNG file, or too large.
            NotConnected: no map server answers.
        """
        self._check_role()
        sha256, key = hashlib.sha256(png).hexdigest(), self._keys.any_put_plan_image()
        for offset in range(0, len(png), PIECE):
            piece = PlanPiece(sha256, len(png), offset, png[offset : offset + PIECE])
            received = decode(self._question(key, encode(piece), ANSWER), PlanReceived)
            if received.image is not None:
                return received.image
        raise InvalidValue("a plan is a PNG file")

    def _check_writable(self, check: bool) -> None:
        self._check_role()

    def _say(self, annotation: Annotation, check: bool) -> str:
        key = sent_by(self._keys.any_annotate(), self._sender)
        return str(
            decode_record(self._question(key, encode(AnnotationRequest(annotation, check)), ANSWER))["said"]
        )

    def constraints(self) -> tuple[ManualConstraint, ...]:
        """What people have linked, unmerged, retired and taken back, in order; the first is number 1.

        Raises:
            NotConnected: no map server answers.
        """
        return decode(self._question(self._keys.any_constraints(), b"", ANSWER), ConstraintList).made

    def keep(self, request: ConstraintRequest) -> str:
        """Have every map server keep a manual constraint; where some refuse it, the words say why."""
        self._check_role()
        key = sent_by(self._keys.any_constrain(), self._sender)
        answers, refused = self._answers(key, encode(request), CHECKING)
        said = [str(decode_record(answer)["said"]) for answer in answers]
        return "\n".join([*said, *(f"another map server refused: {reason}" for reason in refused)])
