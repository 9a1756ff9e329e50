"""The map server: keeps every robot's log, merges the maps, answers lost robots.

Ingest -> Store -> Upkeep -> Answers <- Services <- robots, over the bus
                                     <- Web      <- people, over HTTP
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType

from hybridmap.errors import NotConnected
from hybridmap.explanation import Explanation
from hybridmap.history import Happening
from hybridmap.query import RelocalizeAnswer, View
from mapserver.answers import Answers
from mapserver.blockages import Blockages, BlockageSettings
from mapserver.chronicle import Chronicle
from mapserver.desk import Desk, DeskSettings
from mapserver.explainer import Explainer, RulingBook
from mapserver.herald import Herald
from mapserver.log.ingest import Ingest
from mapserver.log.store import Store
from mapserver.merging.findingskeeper import FindingsKeeper
from mapserver.places.placekeeper import PlaceKeeper
from mapserver.services import Services
from mapserver.upkeep import Upkeep
from merge.merging import MergeSettings
from wire.bus import Bus
from wire.explanation_messages import ExplainRequest
from wire.keys import Keys
from wire.log_messages import Scalar, encode_record

log = logging.getLogger(__name__)

SETTLE_PATIENCE = 120.0
"""In lock-step: how long a question waits for the merged map, s."""


@dataclass(frozen=True)
class ServerSettings:
    """How the server shares its time.

    Attributes:
        status_every: seconds between two status messages.
        merge_share: at most this share of the time is spent making the merged map anew.
        lockstep: answer only when everything that came is merged, one question after the other, so that an
            answer does not depend on the machine's speed, and merge only when asked (simulation only; a
            robot's question must not wait).
        desk: how questions that take long are shared out.
        merge: how maps are merged.
    """

    status_every: float = 0.5
    merge_share: float = 0.4
    lockstep: bool = False
    desk: DeskSettings = field(default_factory=DeskSettings)
    merge: MergeSettings = field(default_factory=MergeSettings)


class MapServer:
    """Store, ingest, merged map and services around one bus. A context manager."""

    def __init__(
        self, bus: Bus, keys: Keys, path: Path, name: str, settings: ServerSettings | None = None
    ) -> None:
        """Open the store and take up where it was left.

        Args:
            bus: the connection.
            keys: of the fleet.
            path: of the store; its folder is made.
            name: of this server in the fleet.
            settings: how it shares its time.

        Raises:
            InvalidFile: the store is damaged or is none.
        """
        self._bus = bus
        self._keys = keys
        self._name = name
        self._settings = s = settings or ServerSettings()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._store = Store(path)
        # In lock-step all must come about again as it did, the cells of the index too.
        self._keeper = None if s.lockstep else PlaceKeeper(self._store, path)
        index = self._keeper.index if self._keeper else None
        findings = None if s.lockstep else FindingsKeeper(path, fresh=not self._store.positions())
        self._chronicle = Chronicle(self._store)
        self._upkeep = Upkeep(
            s.merge_share, by_itself=not s.lockstep, index=index, merge=s.merge, keeper=findings,
            chronicle=self._chronicle,
        )  # fmt: skip
        self._rulings = RulingBook(self._store)
        self._upkeep.rule(self._rulings.rulings)
        self._desk = Desk(replace(s.desk, workers=0) if s.lockstep else s.desk)
        # Wall time says nothing of simulated time, and what it decided would not repeat itself.
        self._blockages = Blockages(BlockageSettings(forget=math.inf) if s.lockstep else BlockageSettings())
        self._stop = threading.Event()
        self._teller = threading.Thread(target=self._tell, name="status", daemon=True)

    def __enter__(self) -> MapServer:
        """Begin to serve."""
        self._upkeep.start()
        self._ingest = Ingest(
            self._bus, self._keys, self._store, self._name, self._upkeep.take, replay=self._upkeep.read
        )
        self._services = Services(
            self._bus, self._keys, self._name, self._in_step, self._desk, self._blockages, self.status,
            # Wall time would make two files of one simulated drive differ.
            lambda: () if self._settings.lockstep else self._chronicle.happenings,
        )  # fmt: skip
        self._explainer = Explainer(
            self._bus, self._keys, self._name, self._in_step, self._desk, self._rulings, self._upkeep.rule,
            # In lock-step whoever asks waits until all is merged.
            lambda: self._settings.lockstep or self._upkeep.settled, self._settings.merge.consistency,
            lambda: self._blockages.known(time.monotonic()), lambda: self._chronicle.happenings,
        )  # fmt: skip
        # Wall time again: what is told now and then would not repeat itself.
        self._herald = None if self._settings.lockstep else Herald(self._bus, self._keys, self._name)
        self._teller.start()
        if self._keeper:
            self._keeper.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop serving; everything that was acknowledged is on the disk already."""
        self._services.close()
        self._explainer.close()
        self._desk.close()
        self._ingest.close()
        self._stop.set()
        if self._herald:
            self._herald.close()
        self._upkeep.close()
        if self._keeper:
            self._keeper.close()
        self._teller.join(5.0)
        self._store.close()

    def summary(self) -> str:
        """One line for people."""
        return self._upkeep.answers.merged.summary()

    def settle(self, timeout: float) -> bool:
        """Wait until everything that came before this call is merged; False if the time is over first."""
        return self._upkeep.settle(timeout)

    def status(self) -> dict[str, Scalar]:
        """What the server holds and does, by name."""
        merged = self._upkeep.answers.merged
        loops = sum(link.within for link in merged.links)
        traffic = self._store.traffic()
        return {
            "nodes": len(merged.postures),
            "superseded": len(merged.superseded),
            "maps": len(merged.maps),
            "components": len(merged.components),
            "links": len(merged.links) - loops,
            "loops": loops,
            "refused": sum(refusal.link is not None for refusal in merged.refused),
            "rulings": len(merged.rulings.in_force),
            "set_apart": len(merged.set_apart),
            "event": self._ingest.failure or self._upkeep.event,
            "settled": self._upkeep.settled,
            "bytes": traffic.payload_bytes,
            "node_puts": traffic.node_puts,
            "summary": merged.summary(),
            **self._desk.counters(),
        }

    def locate(self, look: Callable[[], View], ticket: int) -> Future[RelocalizeAnswer]:
        """Ask where a view was taken, from any thread; as long as robots ask, one waits one's turn.

        Args:
            look: makes the view; called by a worker.
            ticket: the same if the same image comes again, see Desk.submit.

        Raises:
            Busy: too many ask.
        """
        return self._desk.submit(lambda: self._in_step().relocalizer.answer(look()), ticket)

    def explain(self, request: ExplainRequest) -> Future[Explanation]:
        """Ask why nodes or maps are linked or are not, or why a route leads so, from any thread.

        Raises:
            Busy: too many ask.
        """
        return self._desk.submit(lambda: self._explainer.explain(request), usual=False)

    def history(self) -> tuple[Happening, ...]:
        """What has become of the maps and what people have ruled, in order."""
        return self._explainer.history()

    def _in_step(self) -> Answers:
        if self._settings.lockstep and not self.settle(SETTLE_PATIENCE):
            raise NotConnected(f"the merged map was not up to date within {SETTLE_PATIENCE:g} s")
        return self._upkeep.answers

    def _tell(self) -> None:
        while not self._stop.wait(self._settings.status_every):
            self._bus.publish(self._keys.server_status(self._name), encode_record(self.status()))
            if self._herald:
                try:
                    self._herald.tell(self._upkeep.answers.merged)
                except Exception:  # a defect here must not end the status messages
                    log.exception("agents are not told where their nodes lie")
