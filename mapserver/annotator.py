"""What people say about the map: the record of annotations on the disk, and questions about it."""

import logging
import threading
from collections.abc import Callable
from dataclasses import replace

from mapweave.hybridmap.annotation import (
    Annotation,
    AnnotationRequest,
    Annotations,
    Closure,
    Floor,
    Place,
    Preference,
)
from mapweave.hybridmap.constraint_subject import nodes_in_words
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.floor_plan import FloorPlan
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.portal import Portal, PortalMeans
from mapweave.hybridmap.query import ResolveAnswer, ResolveRequest
from mapweave.hybridmap.wall_time import utc_words
from mapweave.mapserver.annotation_effects import effects_of
from mapweave.mapserver.annotation_words import not_there
from mapweave.mapserver.floor_plans import check_plan
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.places import PlaceResolver, why_left_out
from mapweave.mapserver.portals import Portals, check_portal
from mapweave.mapserver.routes import Router
from mapweave.mapserver.services import guarded
from mapweave.merge.floors import floor_of, held_together, parted_by
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.bus import Bus, BusClient, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import encode_said
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import serve_senders

log = logging.getLogger(__name__)

CHECKED = "only checked, nothing is changed: "


class AnnotationRecord:
    """The server's record of annotations, on its disk. Entries are added, never removed."""

    def __init__(self, store: Store, base: Annotations | None = None) -> None:
        """Read the record.

        Args:
            store: where it is kept.
            base: annotations of before, of a map that is there from the start.
        """
        self._store, self._base = store, base
        self._annotations = self._read()

    @property
    def annotations(self) -> Annotations:
        """All of them, in order."""
        return self._annotations

    def add(self, annotation: Annotation) -> None:
        """Add an annotation; it is on the disk when this returns.

        Raises:
            InvalidValue: there are too many.
            InvalidFile: the disk does not take it; then nothing has changed.
        """
        self._store.add_annotation(encode(annotation))
        if self._store.shared:
            self.reload()
        else:
            self._annotations = Annotations((*self._annotations.made, annotation))

    def reload(self) -> bool:
        """Read the record again, to which another server may have added; returns whether it differs."""
        before, self._annotations = self._annotations, self._read()
        return before != self._annotations

    def _read(self) -> Annotations:
        made: list[Annotation] = []
        for body in self._store.annotations():
            try:
                made.append(decode(body, Annotation))
            except InvalidMessage as error:
                log.error("an annotation cannot be read (%s); it is left out", error)
        own = Annotations(tuple(made))
        return self._base + own if self._base is not None and self._base.made else own


class Annotator(BusClient):
    """BusClient on a bus until closed."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        name: str,
        places: Callable[[], PlaceResolver],
        record: AnnotationRecord,
        check: Callable[[Annotation], None],
        constraints: Callable[[], ManualConstraints],
        changed: Callable[[Annotations], None],
        time_ns: Callable[[], int],
    ) -> None:
        """Begin to answer.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            name: of the server in the fleet.
            places: of the newest merged map. May wait for it.
            record: of annotations.
            check: refuses an annotation that lacks something on this server (InvalidValue).
            constraints: the record of manual constraints.
            changed: called with the whole record whenever there is a new entry.
            time_ns: wall time by which closures hold, ns.
        """
        self._places, self._record, self._time_ns = places, record, time_ns
        self._check, self._constraints, self._changed = check, constraints, changed
        self._turn = threading.Lock()
        self._closing = [
            *serve_senders(bus, keys.annotate(name), self._annotate),
            bus.serve(keys.annotations(name), guarded(lambda _: encode(record.annotations))),
            bus.serve(
                keys.resolve(name),
                guarded(lambda payload: encode(self.resolve(decode(payload, ResolveRequest)))),
            ),
        ]

    def resolve(self, request: ResolveRequest) -> ResolveAnswer:
        """Nodes for words, from any thread; see Places.answer."""
        return self._places().answer(request)

    def annotate(self, annotation: Annotation, check: bool = False) -> str:
        """Add an annotation to the record, from any thread; returns what it says and does, in words.

        Args:
            annotation: the new one.
            check: only say what it would do; nothing changes.

        Raises:
            InvalidValue: it says nothing new, or is about something that is not there.
        """
        with self._turn:
            places, annotations = self._places(), self._record.annotations
            check_annotation(places.merged, annotations, annotation, self._constraints())
            check_edge(places.router, annotations, annotation)
            self._check_end(annotation)
            self._check(annotation)
            words = "; ".join((annotation.words, *effects_of(annotation, places)))
            if check:
                return CHECKED + words
            self._record.add(annotation)
            self._changed(self._record.annotations)
        log.warning("%s", words)
        return words

    def _check_end(self, annotation: Annotation) -> None:
        """Refuse a closure that never holds, as of who has a clock that is behind (InvalidValue)."""
        body, now_ns = annotation.body, self._time_ns()
        if isinstance(body, Closure) and not annotation.removed and (body.end_ns or now_ns + 1) <= now_ns:
            now = f"by the clock of the map server, {utc_words(now_ns)}"
            raise InvalidValue(f"{now}, the closure is over already: {body.words}")

    def _annotate(self, request: Request, who: str) -> None:
        def annotate(payload: bytes) -> bytes:
            asked = decode(payload, AnnotationRequest)
            annotation = replace(asked.annotation, who=who or asked.annotation.who)
            return encode_said(self.annotate(annotation, asked.check))

        guarded(annotate)(request)


def check_annotation(
    merged: MergedMap, annotations: Annotations, annotation: Annotation, constraints: ManualConstraints
) -> None:
    """Refuse an annotation that is a mistake.

    Args:
        merged: what it is made about.
        annotations: the record.
        annotation: the new one.
        constraints: manual constraints, merged already or not.

    Raises:
        InvalidValue: it says nothing new, is about something that is not there, or contradicts what else
            people have said.
    """
    kind, name = annotation.kind, annotation.name
    before = annotations.last(kind, name)
    if annotation.removed:
        if before is None:
            raise not_there(kind, name, annotations)
        return
    if before is not None and before.body == annotation.body:
        raise InvalidValue(f"that is known already: {before.words}")
    body = annotation.body
    if isinstance(body, Place | Closure | Preference) and body.area is not None:
        body.area.check_outline()
    if isinstance(body, Closure) and body.end_ns is not None and body.end_ns <= annotation.stamp_ns:
        raise InvalidValue(f"the closure is over already: {body.words}")
    anchor = body.anchor
    merged.check(anchor)
    if merged.component_of(anchor) is None:
        retired = merged.constraints.retires(anchor)
        if retired is not None and constraints.standing(retired.about) is None:
            raise InvalidValue(f"node {anchor} is in use again with the next merge: say it again then")
        raise InvalidValue(f"node {anchor} is not in the merged map{why_left_out(merged, anchor)}")
    match body:
        case FloorPlan():
            check_plan(body, merged)
        case Portal():
            check_portal(merged, annotations, name, body)
        case Floor():
            _check_floor(merged, annotations, body, constraints, annotation.because)


def check_edge(router: Router, annotations: Annotations, annotation: Annotation) -> None:
    """Refuse to close, prefer or avoid an edge that is none: its barrier would hold for the ways of others.

    Args:
        router: of the merged map.
        annotations: the record, with portals.
        annotation: the new one, of any kind.

    Raises:
        InvalidValue: no edge and no portal joins the two, or one is not there.
    """
    body = annotation.body
    if annotation.removed or not isinstance(body, Closure | Preference) or body.edge is None:
        return
    first, second = body.edge
    for node in body.edge:
        router.merged.check(node)
    joined = sorted(router.roads.union.neighbours(first))
    if second in joined or Portals(router.merged, annotations).between(first, second):
        return
    edges = f" ({first} has edges to {nodes_in_words(joined)})" if joined else ""
    raise InvalidValue(f"no edge joins {first} and {second}{edges}: give two nodes of one edge, or an area")


def _check_floor(
    merged: MergedMap, annotations: Annotations, floor: Floor, constraints: ManualConstraints, because: str
) -> None:
    """Refuse a label that contradicts links by hand, drives, or a lift; or that parts a map without a reason.

    Links that robots have found are no evidence against a label, since twin rooms look the same. But a label
    for the wrong map tears what is right, so who parts maps must say why, as with a link without the images.

    Raises:
        InvalidValue: the evidence, and what to do.
    """
    which, label = floor.node.map, floor.label
    floors = {**annotations.floors, which: label}
    if against := held_together(merged, constraints, floors, which):
        raise InvalidValue(
            f"map {which} cannot be on floor {label}: {against}; first take back the other label or the link"
        )
    parting = parted_by(merged, annotations.floors, floor.node, label)
    if parting.parts and not because:
        here = floor_of(merged, annotations.floors, floor.node)
        raise InvalidValue(
            f"map {which} is on floor {here} with maps that it has links with. On floor {label}, "
            f"{parting.words}. If that is right, as of twin floors that look the same, it needs a reason"
        )
    for entry, portal in annotations.in_force(Portal):
        first, second = (floor_of(merged, floors, node) for node in (portal.a, portal.b))
        differ = first and second and first != second
        same = first and first == second
        if which in (portal.a.map, portal.b.map) and (differ if portal.means is PortalMeans.DOOR else same):
            raise InvalidValue(
                f"map {which} cannot be on floor {label}: {entry.words}, so that its sides would be on "
                f"{'one floor' if same else 'two floors'}; first remove that portal"
            )
