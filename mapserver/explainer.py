"""Explanations of merges and routes for people, and their manual constraints."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import TypeVar

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.explanation import (
    MAX_MAPS_LISTED,
    Explanation,
    FleetExplanation,
    MapsExplanation,
    PairExplanation,
    RouteExplanation,
)
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.map_event import History, MapEvent
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.hybridmap.query import ExplainRequest
from mapweave.mapserver.admission_control import AdmissionControl
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.constraint_history import said_of, with_constraints
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.route_explaining import explain_route
from mapweave.mapserver.services import guarded
from mapweave.merge.explanation.map_explanation import explain_fleet, explain_maps
from mapweave.merge.explanation.node_explanation import explain_nodes
from mapweave.merge.manual_constraints import check_manual_constraint
from mapweave.merge.settings import ConsistencySettings
from mapweave.wire.bus import Bus, Closing, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import encode_record
from mapweave.wire.messages import decode, encode

log = logging.getLogger(__name__)

AnyExplanation = TypeVar("AnyExplanation", PairExplanation, MapsExplanation, RouteExplanation)


class ConstraintRecord:
    """The server's record of manual constraints, on its disk. Entries are added, never removed."""

    def __init__(self, store: Store) -> None:
        """Read the record."""
        self._store = store
        made: list[ManualConstraint] = []
        for body in store.constraints():
            try:
                made.append(decode(body, ManualConstraint))
            except InvalidMessage as error:
                log.error("a manual constraint cannot be read (%s); it is left out", error)
        self._constraints = ManualConstraints(made)

    @property
    def constraints(self) -> ManualConstraints:
        """All of them, in order."""
        return self._constraints

    def maps(self) -> list[MapId]:
        """All maps of which the server has anything: they can be retired."""
        return self._store.maps()

    def add(self, constraint: ManualConstraint) -> None:
        """Add a manual constraint; it is on the disk when this returns.

        Raises:
            InvalidValue: there are too many.
            InvalidFile: the disk does not take it; then nothing has changed.
        """
        self._store.add_constraint(encode(constraint))
        self._constraints = ManualConstraints([*self._constraints.made, constraint])


class Explainer:
    """Declared on a bus until closed."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        name: str,
        answers: Callable[[], Answers],
        admission: AdmissionControl,
        record: ConstraintRecord,
        constrain: Callable[[ManualConstraints], None],
        settled: Callable[[], bool],
        consistency: ConsistencySettings,
        wary: Callable[[], Collection[tuple[NodeId, NodeId]]],
        events: Callable[[], Iterable[MapEvent]],
        annotations: Callable[[], Annotations] = Annotations,
    ) -> None:
        """Begin to answer.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            name: of the server in the fleet.
            answers: the newest ones. May wait for them.
            admission: admission control; explanations compare nodes, which takes long.
            record: of manual constraints.
            constrain: called with all constraints whenever there is a new one.
            settled: whether the newest answers know all that has come.
            consistency: as in the merge.
            wary: pairs of nodes between which robots of late did not get through.
            events: what has become of the maps.
            annotations: the record.
        """
        self._answers = answers
        self._admission = admission
        self._record = record
        self._constrain = constrain
        self._settled = settled
        self._consistency = consistency
        self._wary = wary
        self._events = events
        self._annotations = annotations
        self._turn = threading.Lock()
        self._closing: list[Closing] = [
            bus.serve(keys.explain(name), self._explain_later),
            bus.serve(keys.constrain(name), guarded(self._apply_constraint)),
            bus.serve(keys.history(name), guarded(lambda _: encode(History(self.history())))),
        ]

    def close(self) -> None:
        """Stop answering."""
        for closing in self._closing:
            closing.close()

    def _explain_later(self, request: Request) -> None:
        done = self._admission.submit(lambda: self._explain(request.payload), usual=False)
        done.add_done_callback(lambda done: guarded(lambda _: done.result())(request))

    def _explain(self, payload: bytes) -> bytes:
        return encode(self.explain(decode(payload, ExplainRequest)))

    def explain(self, request: ExplainRequest) -> Explanation:
        """Why nodes or maps are linked, or are not, or why a route leads this way. Takes its time.

        Raises:
            InvalidValue: they are not there.
        """
        # Asked first: later changes may be missing in the answers.
        settled = self._settled()
        answers = self._answers()
        merged = answers.merged
        if request.ends is None:
            maps = explain_fleet(merged, MAX_MAPS_LISTED)
            return FleetExplanation(tuple(_still(pair, settled) for pair in maps))
        first, second = request.ends
        if isinstance(first, NodeId) and isinstance(second, NodeId):
            if request.route:
                explanation = explain_route(answers.router, first, second, request.blocked, self._wary())
                return _still(explanation, settled)
            return _still(explain_nodes(merged, first, second, None, self._consistency), settled)
        two = explain_maps(merged, MapId(*first[:2]), MapId(*second[:2]))
        return FleetExplanation((_still(two, settled),))

    def history(self) -> tuple[MapEvent, ...]:
        """The history of the maps, the manual constraints and the annotations, in order."""
        return with_constraints(self._events(), self._record.constraints, self._annotations())

    def _apply_constraint(self, payload: bytes) -> bytes:
        constraint = decode(payload, ManualConstraint)
        with self._turn:
            check_manual_constraint(
                self._answers().merged, self._record.constraints, constraint, self._record.maps()
            )
            self._record.add(constraint)
            self._constrain(self._record.constraints)
        event = said_of(constraint)
        log.warning("%s", event)
        return encode_record({"said": event})


def _still(explanation: AnyExplanation, settled: bool) -> AnyExplanation:
    """Mark an explanation as preliminary while the server merges."""
    return (
        explanation
        if settled
        else replace(explanation, reason=f"{explanation.reason} (still merging: ask again)")
    )
