"""The map server: keeps every robot's log, merges the maps, answers lost robots.

Ingest -> Store -> MergeWorker -> Answers <- Services <- robots, over the bus
                                          <- Web      <- people, over HTTP
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from types import TracebackType

from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus
from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.explanation import Explanation
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.mission_order import MissionKind, MissionReport
from mapweave.hybridmap.query import ExplainRequest
from mapweave.mapserver.admission_control import AdmissionControl, AdmissionSettings
from mapweave.mapserver.annotator import AnnotationRecord, Annotator
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.attendance import ATTENDED, Attendance, AttendanceSettings
from mapweave.mapserver.attendance import EVERY as ATTENDANCE_EVERY
from mapweave.mapserver.base_map import BaseMap
from mapweave.mapserver.blockages import Blockages
from mapweave.mapserver.cluster.cluster import Cluster
from mapweave.mapserver.cluster.settings import ClusterSettings
from mapweave.mapserver.command_history import COMMANDS, CommandHistory
from mapweave.mapserver.explainer import ConstraintRecord, Explainer
from mapweave.mapserver.libraries import library_jobs
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.opening import open_store
from mapweave.mapserver.log.store import ANNOTATIONS, CONSTRAINTS, HISTORY, MERGE_MARK, PRUNING_MARK, News
from mapweave.mapserver.map_history import MapHistory
from mapweave.mapserver.merge_worker import MergeWorker
from mapweave.mapserver.merging.merge_surroundings import MergeSurroundings, Surround
from mapweave.mapserver.merging.pruning_record import PruningRecord
from mapweave.mapserver.merging.verification_cache_keeper import VerificationCacheKeeper
from mapweave.mapserver.metrics import Metrics, Sources
from mapweave.mapserver.mission_relay import EVERY as RETRY_EVERY
from mapweave.mapserver.mission_relay import KEPT as MISSIONS
from mapweave.mapserver.mission_relay import MissionRelay
from mapweave.mapserver.node_views import NodeViews
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.plan_service import PlanService
from mapweave.mapserver.pose_broadcast import PoseBroadcast
from mapweave.mapserver.prompt_reading import PromptReading
from mapweave.mapserver.quotas import Quotas, QuotaSettings
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.mapserver.roster import Roster
from mapweave.mapserver.schedule import LiveSchedule, Schedule
from mapweave.mapserver.services import Services
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Scalar, encode_record

log = logging.getLogger(__name__)

VERSION = version("mapweave")


@dataclass(frozen=True)
class ServerSettings:
    """How the server shares its time.

    Attributes:
        admission_control: how questions that take long are shared out.
        merge: how maps are merged.
        quotas: what it takes of one robot.
        cluster: among whose processes the place index is split.
        attendance: what robots do once no operator is there.
    """

    admission_control: AdmissionSettings = field(default_factory=AdmissionSettings)
    merge: MergeSettings = field(default_factory=MergeSettings)
    quotas: QuotaSettings = field(default_factory=QuotaSettings)
    cluster: ClusterSettings = field(default_factory=ClusterSettings)
    attendance: AttendanceSettings = field(default_factory=AttendanceSettings)


STATUS_EVERY = 0.5
"""Time between two status messages, s."""
RELAYS = 4
"""Missions that wait for their robots' answers at once."""
MERGE_SHARE = 0.4
"""Largest share of the time that is spent merging."""


class MapServer:
    """Store, ingest, merged map and services around one bus. A context manager."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        address: Path | str,
        name: str,
        settings: ServerSettings | None = None,
        schedule: Schedule | None = None,
        base: BaseMap | None = None,
        cache: Path | None = None,
        surroundings: Surround = MergeSurroundings.live,
    ) -> None:
        """Open the store and take up where it was left.

        Args:
            bus: the connection.
            keys: of the fleet.
            address: of the store: a file, whose folder is made, or the address of a PostgreSQL database.
            name: of this server in the fleet.
            settings: how it shares its time.
            schedule: runs its work and gives the time; threads and the machine's clock by default. It
                starts and ends with the server.
            base: a map that is there from the start, beside the store.
            cache: folder for what is kept beside a store in PostgreSQL; made if it is not there.
            surroundings: what merging depends on besides; the other one is for repeatable runs.

        Raises:
            InvalidFile: the store is damaged or is none, is another server's, or has another map of a name
                that is in the base.
        """
        self._bus = bus
        self._keys = keys
        self._name = name
        self._settings = s = settings or ServerSettings()
        self._schedule = clock = schedule or LiveSchedule()
        path = address if isinstance(address, Path) else (cache or Path()) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._store = open_store(address, name)
        try:
            self._take_up(path, base, s, surroundings)
        except BaseException:
            # Another attempt could not have the server's name while a session of this one held it.
            clock.close()
            self._store.close()
            raise

    def _take_up(
        self,
        path: Path,
        base: BaseMap | None,
        s: ServerSettings,
        surroundings: Surround,
    ) -> None:
        """All that the store has, and what works on it; nothing runs yet."""
        clock, name = self._schedule, self._name
        self._base = (base or BaseMap()).beside(self._store)
        self._cluster = Cluster(s.cluster)
        places = PlaceDatabase(self._cluster.index)
        findings = VerificationCacheKeeper(path, not self._store.positions(), clock.monotonic)
        self._history = MapHistory(self._store, clock=clock.time_ns)
        self._metrics = Metrics()
        pruning = PruningRecord(
            self._store, s.merge.keep_superseded_days, self._said, base.maps if base else (), clock.monotonic
        )
        around = surroundings(self._store, name, path, clock.monotonic)
        self._worker = MergeWorker(
            clock, MERGE_SHARE, places, s.merge,
            keeper=findings, history=self._history, compare=self._cluster.compare,
            observe=self._metrics.merged, pruning=pruning,
            stored=around.stored, retry=around.retry, choice_key=around.choice_key,
        )  # fmt: skip
        self._constraints = ConstraintRecord(self._store, self._base)
        self._annotations = AnnotationRecord(self._store, self._base.annotations)
        self._pins, self._floors = self._annotations.annotations.pins, self._annotations.annotations.floors
        self._constrain()
        self._worker.pin(self._pins)
        for map_id, reason in self._base.refused_changes.items():
            self._worker.note_refusal(map_id, reason)
        self._path = path
        self._admission = AdmissionControl(
            s.admission_control, clock.monotonic, clock.executor(s.admission_control.threads)
        )
        self._blockages = Blockages()
        self._quotas = Quotas(s.quotas, clock.monotonic)
        self._counting = clock.executor(1)
        self._counts = PromptReading(
            lambda: (self._store.traffic(), self._damaged()), self._counting, clock.monotonic
        )

    def __enter__(self) -> MapServer:
        """Begin to serve."""
        try:
            self._begin()
        except BaseException:
            # Whatever still runs in a library written in C++ when the interpreter ends aborts the process.
            self._schedule.close()
            self._cluster.close()
            self._store.close()
            raise
        return self

    def _begin(self) -> None:
        worker, clock = self._worker, self._schedule
        self._cluster.start()
        worker.start()
        base = self._base
        self._commands = CommandHistory(self._store, clock.time_ns, clock.post)
        self._missions = MissionRelay(
            self._bus, self._keys, self._store, self._named_places, clock.time_ns,
            later=clock.post, note=self._commands.order, monotonic=clock.monotonic,
        )  # fmt: skip
        self._roster = Roster(
            self._bus, self._keys, clock.monotonic, self._hear, self._quotas,
            lags=lambda: self._ingest.lags(),
        )  # fmt: skip
        self._missions.roster = self._roster
        self._attendance = Attendance(
            self._settings.attendance, self._name, self._missions, self._store, self._roster.alive,
            clock.monotonic,
        )  # fmt: skip
        self._ingest = Ingest(
            self._bus, self._keys, self._store, self._name,
            on_change=worker.take, replay=lambda stored: worker.read(base.before(stored)),
            objection=base.objection, taken=[*base.maps], quotas=self._quotas, retired=self._gone,
            unmerged=worker.unmerged, note_refusal=worker.note_refusal, note_disbelief=worker.note_disbelief,
            observe_ack=self._metrics.acknowledged, status_period=self._roster.status_period_of,
            pruned=self._was_pruned,
        )  # fmt: skip
        self._roster.remind = self._ingest.remind
        clock.give_way(lambda: self._ingest.busy or self._admission.busy)
        self._plans = PlanService(
            self._bus, self._keys, self._name,
            merged=lambda: worker.current().merged, annotations=lambda: self._annotations.annotations,
            store=self._path, beside=base.images, shared=self._store if self._store.shared else None,
        )  # fmt: skip
        self._services = Services(
            self._bus, self._keys, self._name, self._answers, self._admission, self._blockages,
            status=self.status, history=self._events, missions=self._missions, roster=self._roster,
            relays=clock.executor(RELAYS), clock=clock.monotonic, executor=clock.executor(1),
            places=self._named_places, images=self._plans.files, quotas=self._quotas,
            observe=self._metrics.relocalized,
        )  # fmt: skip
        self._explainer = Explainer(
            self._bus, self._keys, self._name, self._answers, self._admission, self._constraints,
            constrain=lambda _: self._constrain(), settled=lambda: worker.settled,
            settings=self._settings.merge, wary=lambda: self._blockages.known(clock.monotonic()),
            events=lambda: (*self._events(), *self._commands.events),
            annotations=lambda: self._annotations.annotations,
        )  # fmt: skip
        self._annotator = Annotator(
            self._bus, self._keys, self._name, self._named_places, self._annotations,
            check=self._plans.check, constraints=lambda: self._constraints.constraints,
            changed=self._apply_annotations, time_ns=clock.time_ns,
        )  # fmt: skip
        self._views = views = NodeViews(self._bus, self._keys, lambda: worker.current().merged)
        # What people ask, from any thread; see mapserver.http.answering.
        self.locate, self.map_file = self._services.locate, self._services.map_file
        self.history, self.constraints = self._explainer.history, self._explainer.constraints
        self.constrain, self.annotate = self._explainer.constrain, self._annotator.annotate
        self.plans, self.plan_image = self._plans.plans, self._plans.image
        self.put_plan_image, self.kept_image = self._plans.put, self._plans.images.get
        self.resolve, self.why_no_view, self.view = self._annotator.resolve, views.why_none, views.view
        self.command, self.missions = self._missions.command, self._missions.missions
        self.attend = self._attendance.attend
        self.portal_done, self.metrics = self._missions.portal_done, self._metrics.scrape
        self._broadcast = PoseBroadcast(self._bus, self._keys, self._name, clock=clock.monotonic)
        self._metrics.read(self._sources())
        clock.every(STATUS_EVERY, self._publish)
        clock.every(RETRY_EVERY, self._missions.retry)
        clock.every(RETRY_EVERY, self._commands.write)
        clock.every(ATTENDANCE_EVERY, self._attendance.check)
        self._store.follow(self._follow)
        # Behind the reading of the store: its map can be seen meanwhile.
        for job in library_jobs():
            clock.post(job)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop serving; everything that was acknowledged is on the disk already."""
        self._services.close()
        self._roster.close()
        self._explainer.close()
        self._annotator.close()
        self._plans.close()
        self._views.close()
        self._admission.close()
        self._ingest.close()
        self._broadcast.close()
        self._cluster.close()
        self._worker.close()
        self._missions.close()
        self._commands.write()
        self._counting.shutdown()
        self._store.close()

    def summary(self) -> str:
        """One line for people."""
        return self._worker.answers.merged.summary()

    def settle(self, timeout: float) -> bool:
        """Wait until everything that came before this call is merged; False if the time is over first."""
        return self._worker.settle(timeout)

    @property
    def displaced(self) -> str:
        """Why this server must end, in one line: another one of its name has the store. Else empty."""
        return self._store.displaced

    @property
    def broken(self) -> str:
        """Why this server must end and start again, in one line: it takes nothing in. Else empty."""
        return self._ingest.broken

    @property
    def read_only(self) -> bool:
        """Whether nothing can be changed, as with a map file."""
        return False

    def merged(self) -> MergedMap:
        """The newest merged map."""
        return self._worker.current().merged

    def status(self) -> dict[str, Scalar]:
        """What the server holds and does, by name."""
        merged = self._worker.answers.merged
        (traffic, damaged), unread = self._counts.newest()
        return {
            **merged.counts(),
            **(self._merging() if self._store.shared else {}),
            **({"unattended": words} if (words := self._settings.attendance.words) else {}),
            "over_quota": ", ".join(self._quotas.over())[:1000],
            "damaged": damaged,
            "event": self._ingest.failure or unread or self._worker.event,
            "commands": self._commands.count,
            "settled": self._worker.settled,
            "merged": self._worker.begun,
            "unmerged_s": round(self._worker.unmerged_seconds, 1),
            "delay": self._worker.delay,
            "bytes": traffic.payload_bytes,
            "node_puts": traffic.node_puts,
            "summary": merged.summary(),
            "version": VERSION,
            "cluster": self._cluster.status,
            **self._admission.counters(),
        }

    def _merging(self) -> dict[str, Scalar]:
        """Which of the servers that share the store leads, and how this one comes by its merged map."""
        return {
            "name": self._name,
            "leads": self._store.leads,
            "leader": self._store.leader,
            "behind": self._worker.behind,
            "merges_itself": self._worker.alone,
        }

    def explain(self, request: ExplainRequest) -> Future[Explanation]:
        """Ask why nodes or maps are linked or are not, or why a route leads so, from any thread.

        Raises:
            Busy: too many ask.
        """
        return self._admission.submit(lambda: self._explainer.explain(request), usual=False)

    def annotations(self) -> Annotations:
        """What people say about the map."""
        return self._annotations.annotations

    def give(
        self,
        robot: str,
        kind: MissionKind,
        goal: str,
        by: str,
        mission_id: str = "",
        via: tuple[str, ...] = (),
        because: str = "",
    ) -> MissionReport:
        """Give a robot a mission that is newer than the one that holds it; see `command`."""
        return self._missions.command(self._missions.request(robot, kind, goal, by, mission_id, via, because))

    def robots(self) -> FleetStatus:
        """The robots, and where they are."""
        return self._services.robots()

    def _sources(self) -> Sources:
        worker, ingest = self._worker, self._ingest
        return Sources(
            store=self._path,
            ingest=ingest.counters,
            merger=worker.counters,
            counts=lambda: worker.answers.merged.counts(),
            held_back=self._quotas.totals,
            dropped=lambda: self._bus.dropped,
            admission=self._admission.counters,
            lags=ingest.lags,
            robots=self._roster.presence,
            over_quota=self._quotas.over,
            damaged=self._damaged,
            queues=lambda: {"ingest": ingest.waiting, **worker.queues()},
            failing=lambda: bool(ingest.failure),
            settled=lambda: worker.settled,
            leads=lambda: self._store.leads,
            merges_itself=lambda: bool(worker.alone),
            unmerged=lambda: worker.unmerged_seconds,
        )

    def _follow(self, news: News) -> None:
        """Take over what another server has written to the store; in the store's thread."""
        self._ingest.follow(news)
        if news.names(CONSTRAINTS) and self._constraints.reload():
            self._constrain()
        if news.names(ANNOTATIONS) and self._annotations.reload():
            self._apply_annotations(self._annotations.annotations)
        if news.names(MISSIONS):
            self._missions.reload()
        if news.records is not None and ATTENDED in news.records:
            self._attendance.follow()
        if news.names(COMMANDS):
            self._commands.reload()
        if news.names(HISTORY) and not self._store.leads:
            self._history.reload()
        if news.names(PRUNING_MARK):
            self._worker.follow_pruning()
        if news.names(MERGE_MARK):
            self._worker.follow_merges()

    def _damaged(self) -> int:
        """Changes that are damaged on the disk."""
        return sum(gap.last - gap.first + 1 for gap in self._store.damaged())

    def _said(self) -> Iterator[object]:
        """All that people have said of nodes."""
        yield from self._constraints.constraints.made
        yield from self._annotations.annotations.made

    def _was_pruned(self, node: NodeId) -> bool:
        """Whether a node has left the map for good, since it was superseded for long."""
        merged = self._worker.answers.merged
        return node in merged.pruned and node not in merged.poses

    def _gone(self) -> Collection[MapId]:
        """Maps that people have retired, or of which nothing is left."""
        merged = self._worker.answers.merged
        return {*self._constraints.constraints.retired, *(merged.pruned.maps - merged.maps.keys())}

    def _constrain(self) -> None:
        """Merge by the constraints and the floors of the records."""
        self._worker.constrain(self._constraints.constraints.with_floors(self._floors))

    def _hear(self, status: AgentStatus) -> None:
        self._schedule.observe(status.stamp_ns)
        self._missions.hear(status)
        if status.drive is not None:
            self._commands.drive(status.robot, status.drive)

    def _apply_annotations(self, annotations: Annotations) -> None:
        # A merge takes its time: only what moves a frame, or parts maps, is worth one.
        if annotations.pins != self._pins:
            self._pins = annotations.pins
            self._worker.pin(self._pins)
        if annotations.floors != self._floors:
            self._floors = annotations.floors
            self._constrain()

    def _answers(self) -> Answers:
        """The newest ones, with routes by what is closed now."""
        answers = self._worker.current()
        router = answers.router.at(self._annotations.annotations, self._schedule.time_ns())
        return replace(answers, router=router)

    def _named_places(self) -> PlaceResolver:
        return PlaceResolver(self._answers().router, self._annotations.annotations)

    def _events(self) -> tuple[MapEvent, ...]:
        """What has become of the maps, those of the base included."""
        events = dict.fromkeys((*self._base.history, *self._history.events))
        return tuple(sorted(events, key=lambda event: event.stamp_ns))

    def _publish(self) -> None:
        self._bus.publish(self._keys.server_status(self._name), encode_record(self.status()))
        self._broadcast.tell(self._worker.answers.merged)
