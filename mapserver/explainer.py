"""People's questions why maps are one and why routes lead so, and rulings that maps shall not be one."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import TypeVar

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.explanation import (
    MAX_MAPS_TOLD,
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
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.route_explaining import explain_route
from mapweave.mapserver.ruling_history import said_of, with_rulings
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

Told = TypeVar("Told", PairExplanation, MapsExplanation, RouteExplanation)


class RulingBook:
    """The server's record of what people have ruled, on its disk. Entries are added, never taken out."""

    def __init__(self, store: Store) -> None:
        """Read the record."""
        self._store = store
        made: list[ManualConstraint] = []
        for body in store.rulings():
            try:
                made.append(decode(body, ManualConstraint))
            except InvalidMessage as error:
                log.error("a manual constraint cannot be read (%s); it is left out", error)
        self._rulings = ManualConstraints(made)

    @property
    def rulings(self) -> ManualConstraints:
        """All of them, in order."""
        return self._rulings

    def maps(self) -> list[MapId]:
        """All maps of which the server has anything: they can be retired."""
        return self._store.maps()

    def add(self, ruling: ManualConstraint) -> None:
        """Enter a ruling; it is on the disk when this returns.

        Raises:
            InvalidValue: there are too many.
            InvalidFile: the disk does not take it; then nothing has changed.
        """
        self._store.add_ruling(encode(ruling))
        self._rulings = ManualConstraints([*self._rulings.made, ruling])


class Explainer:
    """Declared on a bus until closed."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        name: str,
        answers: Callable[[], Answers],
        desk: AdmissionControl,
        book: RulingBook,
        rule: Callable[[ManualConstraints], None],
        settled: Callable[[], bool],
        consistency: ConsistencySettings,
        wary: Callable[[], Collection[tuple[NodeId, NodeId]]],
        happenings: Callable[[], Iterable[MapEvent]],
    ) -> None:
        """Begin to answer.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            name: of the server in the fleet.
            answers: the newest ones. May wait for them.
            desk: explanations compare nodes, which takes long.
            book: where rulings are kept.
            rule: told all rulings whenever there is a new one.
            settled: whether the newest answers know all that has come.
            consistency: as in the merge.
            wary: pairs of nodes between which robots of late did not get through.
            happenings: what has become of the maps.
        """
        self._answers = answers
        self._desk = desk
        self._book = book
        self._rule = rule
        self._settled = settled
        self._consistency = consistency
        self._wary = wary
        self._happenings = happenings
        self._turn = threading.Lock()
        self._closing: list[Closing] = [
            bus.serve(keys.explain(name), self._explain_later),
            bus.serve(keys.rule(name), guarded(self._decree)),
            bus.serve(keys.history(name), guarded(lambda _: encode(History(self.history())))),
        ]

    def close(self) -> None:
        """Stop answering."""
        for closing in self._closing:
            closing.close()

    def _explain_later(self, request: Request) -> None:
        done = self._desk.submit(lambda: self._explain(request.payload), usual=False)
        done.add_done_callback(lambda done: guarded(lambda _: done.result())(request))

    def _explain(self, payload: bytes) -> bytes:
        return encode(self.explain(decode(payload, ExplainRequest)))

    def explain(self, request: ExplainRequest) -> Explanation:
        """Why nodes or maps are linked, or are not, or why a route leads this way. Takes its time.

        Raises:
            InvalidValue: they are not there.
        """
        # Asked first: what comes meanwhile may be missing in the answers.
        settled = self._settled()
        answers = self._answers()
        merged = answers.merged
        if request.ends is None:
            maps = explain_fleet(merged, MAX_MAPS_TOLD)
            return FleetExplanation(tuple(_still(one, settled) for one in maps))
        first, second = request.ends
        if isinstance(first, NodeId) and isinstance(second, NodeId):
            if request.route:
                told = explain_route(answers.router, first, second, request.blocked, self._wary())
                return _still(told, settled)
            return _still(explain_nodes(merged, first, second, None, self._consistency), settled)
        two = explain_maps(merged, MapId(*first[:2]), MapId(*second[:2]))
        return FleetExplanation((_still(two, settled),))

    def history(self) -> tuple[MapEvent, ...]:
        """What has become of the maps, and what people have ruled, in order."""
        return with_rulings(self._happenings(), self._book.rulings)

    def _decree(self, payload: bytes) -> bytes:
        ruling = decode(payload, ManualConstraint)
        with self._turn:
            check_manual_constraint(self._answers().merged, self._book.rulings, ruling, self._book.maps())
            self._book.add(ruling)
            self._rule(self._book.rulings)
        said = said_of(ruling)
        log.warning("%s", said)
        return encode_record({"said": said})


def _still(told: Told, settled: bool) -> Told:
    """What was not found yet is not said to be missing."""
    return told if settled else replace(told, reason=f"{told.reason} (still merging: ask again)")
