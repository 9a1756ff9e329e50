"""What an agent tells Prometheus about itself, on this machine alone.

The loop counts in plain numbers; everything else is read from the agent's status and counters when it is
asked for, on the threads of the HTTP server. `docs/monitoring.md` lists the names.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from itertools import accumulate

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import (
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from mapweave.agent.fleet_client import FAILED
from mapweave.agent.mission import MayIDrive, Question, WhatIsKnown, WhereAmI, WhichWay, WhoIsNear
from mapweave.agent.pipeline import TickResult
from mapweave.agent.replication.replicator import ReplicationStatus
from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.errors import NotConnected, SettingsError
from mapweave.hybridmap.mission_order import MissionKind, MissionState
from mapweave.hybridmap.query import Certainty
from mapweave.mapserver.metric_families import MetricFamilies
from mapweave.processes.metrics_server import HOST, serve_metrics

_FAMILIES = MetricFamilies("mapweave_agent_")
_gauge, _counter = _FAMILIES.gauge, _FAMILIES.counter
TICK_BUCKETS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""s; a tick that takes longer than 0.1 skips images."""
SENSORS = ("clock", "camera", "encoders", "rangers")
QUESTIONS: dict[type[Question], str] = {
    WhereAmI: "place",
    WhichWay: "route",
    WhatIsKnown: "coverage",
    MayIDrive: "right_of_way",
    WhoIsNear: "nearby",
}


@dataclass(frozen=True)
class AgentSources:
    """Where the numbers come from; each is called with every scrape, from any thread.

    Attributes:
        status: of the robot, as the fleet sees it.
        replication: where its changes are.
        asked: questions to the fleet, by their type.
        relocalized: answers where a view was taken, by certainty or `failed`.
        refuted: answers that the robot's view did not bear out.
        arrivals: how often the map server came in reach.
    """

    status: Callable[[], AgentStatus]
    replication: Callable[[], ReplicationStatus]
    asked: Callable[[], Mapping[type[Question], int]]
    relocalized: Callable[[], Mapping[str, int]]
    refuted: Callable[[], int]
    arrivals: Callable[[], int]


class AgentMetrics(Collector):
    """The metrics of one agent during its life. The loop calls `step`, and never waits for a scrape."""

    def __init__(self, robot: str) -> None:
        """Begin with nothing counted of a robot."""
        self._robot = robot
        self._ticks, self._seconds = 0, 0.0
        self._buckets = [0] * (len(TICK_BUCKETS) + 1)
        self._faulty = ""
        self._faults: Counter[str] = Counter()
        self._sources: AgentSources | None = None
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def read(self, sources: AgentSources) -> None:
        """Read these with every scrape."""
        self._sources = sources

    def step(self, step: TickResult, busy: float) -> None:
        """Take in a tick.

        Args:
            step: what it gave.
            busy: how long the tick before took, s; 0 if that is not known.
        """
        self._ticks += 1
        if busy > 0.0:
            self._buckets[bisect_left(TICK_BUCKETS, busy)] += 1
            self._seconds += busy
        faulty = "" if step.fault is None else step.fault.sensor
        if faulty and faulty != self._faulty:
            self._faults[faulty] += 1
        self._faulty = faulty

    def scrape(self) -> bytes:
        """Everything, in the text format of Prometheus."""
        return generate_latest(self._registry)

    def serve(self, port: int) -> Callable[[], None]:
        """Answer on a port of this machine, on threads of its own; returns what ends that.

        Raises:
            SettingsError: there is no such port.
            NotConnected: it is taken, or not for this user.
        """
        if not 0 < port < 65536:
            raise SettingsError(f"--metrics {port}: give a port, for example 9101")
        try:
            return serve_metrics(port, self._registry)
        except OSError as error:
            where = f"{HOST}:{port} ({error.strerror})"
            raise NotConnected(f"--metrics: cannot listen at {where}; choose another port") from error

    def collect(self) -> Iterator[Metric]:
        """All metrics; called by the registry."""
        info = GaugeMetricFamily(
            "mapweave_agent_info", "The robot, and its agent.", labels=["robot", "version"]
        )
        info.add_metric([self._robot, version("mapweave")], 1.0)
        yield info
        yield _counter("ticks", "Observations that were taken in.", self._ticks)
        bounds = [*map(str, TICK_BUCKETS), "+Inf"]
        counts = [*accumulate(self._buckets)]
        yield HistogramMetricFamily(
            "mapweave_agent_tick_seconds", "Time that a tick takes.",
            buckets=[*zip(bounds, counts, strict=True)], sum_value=self._seconds,
        )  # fmt: skip
        faulty = {one: float(one == self._faulty) for one in SENSORS}
        yield _gauge("sensor_faulty", "Whether the robot stands because of this sensor.", faulty, "sensor")
        faults = {one: float(self._faults[one]) for one in SENSORS}
        yield _counter("sensor_faults", "Times that this sensor began to fail.", faults, "sensor")
        if self._sources is not None:
            yield from self._status(self._sources.status())
            yield from self._replication(self._sources.replication())
            yield from self._fleet(self._sources)

    def _status(self, status: AgentStatus) -> Iterator[Metric]:
        now, mission = status.status, status.mission
        yield _gauge("nodes", "Nodes of the map that it makes.", now.nodes)
        yield _gauge("nodes_placed", "Of these, nodes with a pose in the merged map.", status.placed)
        yield _gauge("tracked_features", "Features that it follows in the image.", now.tracked)
        yield _gauge("localized", "Whether it knows where it is on its own map.", float(now.located))
        yield _gauge("lost", "Whether it cannot find itself on its own map.", float(now.lost))
        yield _counter(
            "images_skipped", "Images that were skipped because a tick took too long.", status.skipped
        )
        kind, state = (None, None) if mission is None else (mission.order.kind, mission.state)
        kinds = {str(one): float(one == kind) for one in MissionKind}
        yield _gauge("mission_kind", "The kind of the mission that holds.", kinds, "kind")
        states = {str(one): float(one == state) for one in MissionState}
        yield _gauge("mission_state", "What has become of it.", states, "state")
        progress = 0.0 if mission is None else mission.progress
        yield _gauge("mission_progress", "Share of the present route that is driven.", progress)
        if status.battery is not None:
            yield _gauge("battery_charge", "Charge of the battery, as a share.", status.battery)
        yield _gauge("server_in_reach", "Whether it reaches its map server.", float(status.linked))
        yield _counter("network_bytes", "Sent and received over the fleet's network.", status.traffic)

    def _replication(self, now: ReplicationStatus) -> Iterator[Metric]:
        yield _gauge("changes_unsaved", "Changes that are not on its own disk yet.", now.waiting)
        yield _gauge("changes_unacknowledged", "Saved changes that servers lack.", now.unacknowledged)
        yield _gauge("changes_refused", "Changes that a server has refused for good.", now.refused)
        yield _gauge(
            "saving_fails", "Whether its disk or server takes nothing now.", float(bool(now.failure))
        )

    def _fleet(self, sources: AgentSources) -> Iterator[Metric]:
        yield _counter("server_arrivals", "Times that its map server came in reach.", sources.arrivals())
        asked, answers = sources.asked(), sources.relocalized()
        questions = {words: float(asked.get(kind, 0)) for kind, words in QUESTIONS.items()}
        yield _counter("questions", "Questions to the fleet.", questions, "question")
        outcomes = {one: float(answers.get(one, 0)) for one in (*map(str, Certainty), FAILED)}
        yield _counter("relocalizations", "Answers where a view was taken.", outcomes, "outcome")
        yield _counter("answers_refuted", "Answers that its own view did not bear out.", sources.refuted())
