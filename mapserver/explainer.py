"""Explanations of merges and routes for people, and their manual constraints."""

import logging
import threading
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from itertools import accumulate
from typing import TypeVar

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.explanation import (
    Explanation,
    FleetExplanation,
    MapsExplanation,
    PairExplanation,
    RouteExplanation,
)
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import (
    ConstraintList,
    ConstraintRequest,
    ManualConstraint,
    ManualConstraints,
)
from mapweave.hybridmap.map_event import History, MapEvent
from mapweave.hybridmap.query import ExplainRequest
from mapweave.mapserver.admission_control import AdmissionControl
from mapweave.mapserver.annotation_effects import without_effect
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.base_map import BaseMap
from mapweave.mapserver.constraint_history import with_constraints
from mapweave.mapserver.explanations import explained
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.services import guarded
from mapweave.merge.constraint_checks import check_manual_constraint
from mapweave.merge.settings import MergeSettings
from mapweave.merge.unmerged_links import with_unmerged_links
from mapweave.wire.bus import Bus, BusClient, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import encode_said
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import serve_senders

log = logging.getLogger(__name__)

AnyExplanation = TypeVar("AnyExplanation", bound=PairExplanation | MapsExplanation | RouteExplanation)


class ConstraintRecord:
    """The server's record of manual constraints, on its disk. Entries are added, never removed."""

    def __init__(self, store: Store, base: BaseMap | None = None) -> None:
        """Read the record.

        Args:
            store: where it is kept.
            base: has constraints of before, and maps that can be retired, too.
        """
        self._store = store
        self._base = base or BaseMap()
        self._constraints = self._read()

    @property
    def constraints(self) -> ManualConstraints:
        """All of them, in order."""
        return self._constraints

    def maps(self) -> list[MapId]:
        """All maps of which the server has anything: they can be retired."""
        return sorted({*self._store.maps(), *self._base.maps})

    def add(self, constraint: ManualConstraint) -> None:
        """Add a manual constraint; it is on the disk when this returns.

        Raises:
            InvalidValue: there are too many.
            InvalidFile: the disk does not take it; then nothing has changed.
        """
        self._store.add_constraint(encode(constraint))
        if self._store.shared:
            self.reload()
        else:
            self._constraints = ManualConstraints([*self._constraints.made, constraint])

    def reload(self) -> bool:
        """Read the record again, to which another server may have added; returns whether it differs."""
        before, self._constraints = self._constraints, self._read()
        return before.made != self._constraints.made

    def _read(self) -> ManualConstraints:
        made: list[ManualConstraint] = []
        for body in self._store.constraints():
            try:
                made.append(decode(body, ManualConstraint))
            except InvalidMessage as error:
                log.error("a manual constraint cannot be read (%s); it is left out", error)
        if not self._base.constraints.made:
            return ManualConstraints(made)
        # By date only where there are two records, each of which is in order: clocks differ, and what comes
        # behind a constraint of far ahead may take it back.
        dated: dict[ManualConstraint, int] = {}
        for record in (self._base.constraints.made, made):
            latest = accumulate((one.stamp_ns for one in record), max)
            dated |= {one: at for one, at in zip(record, latest, strict=True) if one not in dated}
        return ManualConstraints(sorted(dated, key=lambda one: dated[one]))


class Explainer(BusClient):
    """BusClient on a bus until closed."""

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
        settings: MergeSettings,
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
            settings: of the merge.
            wary: pairs of nodes between which robots of late did not get through.
            events: what has become of the maps.
            annotations: the record.
        """
        self._answers = answers
        self._admission = admission
        self._record = record
        self._constrain = constrain
        self._settled = settled
        self._settings = settings
        self._wary = wary
        self._events = events
        self._annotations = annotations
        self._turn = threading.Lock()
        self._closing = [
            bus.serve(keys.explain(name), self._explain_later),
            *serve_senders(bus, keys.constrain(name), self._constrain_later),
            bus.serve(keys.constraints(name), guarded(lambda _: encode(self.constraints()))),
            bus.serve(keys.history(name), guarded(lambda _: encode(History(self.history())))),
        ]

    def _explain_later(self, request: Request) -> None:
        self._later(request, lambda: self._explain(request.payload))

    def _constrain_later(self, request: Request, who: str) -> None:
        """A link is compared with the images and the map, which takes its time."""

        def constrain() -> bytes:
            asked = decode(request.payload, ConstraintRequest)
            if who:
                asked = replace(asked, constraint=replace(asked.constraint, who=who))
            return encode_said(self.constrain(asked))

        self._later(request, constrain)

    def _later(self, request: Request, answer: Callable[[], bytes]) -> None:
        done = self._admission.submit(answer, usual=False)
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
        explanation = explained(request, self._answers().router, self._settings.consistency, self._wary())
        if isinstance(explanation, FleetExplanation):
            return replace(explanation, maps=tuple(_still(pair, settled) for pair in explanation.maps))
        return _still(explanation, settled)

    def history(self) -> tuple[MapEvent, ...]:
        """The history of the maps, the manual constraints and the annotations, in order."""
        return with_constraints(self._events(), self._record.constraints, self._annotations())

    def constraints(self) -> ConstraintList:
        """The record of manual constraints, in order."""
        return ConstraintList(self._record.constraints.made)

    def constrain(self, request: ConstraintRequest) -> str:
        """Keep a manual constraint, on the disk, and merge with it; or only say what it would do.

        Returns:
            What was decided, and its effects, in words.

        Raises:
            InvalidValue: it has no effect, or the evidence against it.
            InvalidFile: the disk does not take it.
        """
        with self._turn:
            made = self._record.constraints.with_floors(self._annotations().floors)
            # Of two links in quick succession the second must fit the first.
            merged = with_unmerged_links(self._answers().merged, made, self._settings.consistency)
            checked = check_manual_constraint(
                merged, made, request.constraint, self._record.maps(), self._settings
            )
            lost = without_effect(checked.constraint, merged, self._annotations())
            words = "; ".join(filter(None, (checked.words, lost)))
            if request.check:
                return f"only checked, nothing is changed: {words}"
            self._record.add(checked.constraint)
            self._constrain(self._record.constraints)
        log.warning("%s", words)
        return words


def _still(explanation: AnyExplanation, settled: bool) -> AnyExplanation:
    """Mark an explanation as preliminary while the server merges."""
    return (
        explanation
        if settled
        else replace(explanation, reason=f"{explanation.reason} (still merging: ask again)")
    )
