"""What the map server tells Prometheus: counters, latencies, sizes, and how far it is behind each robot.

Counters that the server keeps for itself are read when they are asked for. Names follow the conventions of
Prometheus; `docs/monitoring.md` lists them.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from prometheus_client import CollectorRegistry, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from mapweave.hybridmap.errors import Busy
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer
from mapweave.mapserver.log.ingest_counters import IngestCounters
from mapweave.mapserver.log.known_logs import Lag
from mapweave.mapserver.merging.merger_counters import MergerCounters
from mapweave.mapserver.metric_families import MetricFamilies
from mapweave.mapserver.roster import NO_LAG, Presence

_FAMILIES = MetricFamilies("mapweave_")
_gauge, _counter = _FAMILIES.gauge, _FAMILIES.counter
ACK_BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""s; asked for is a 99th percentile below 0.5."""
RELOCALIZE_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
"""s; asked for is a 95th percentile below 0.25."""
MERGE_BUCKETS = (0.01, 0.05, 0.1, 0.5, 1.0, 5.0, 10.0, 60.0, 300.0)
"""s"""
FAILED = "failed"
"""In place of the certainty of an answer."""
FILES = {
    "log": "",
    "write_ahead_log": "-wal",
    "verdicts": ".verdicts",
    "superseded": ".superseded",
}
"""What the server keeps on the disk, and how it is called behind the name of the store."""

INGEST = {
    "messages": ("changes_received", "Changes that robots published to this server."),
    "message_bytes": ("changes_received_bytes", "Bytes in these, as they came."),
    "applied": ("changes_taken", "Changes that were new and are on the disk."),
    "doubled": ("changes_doubled", "Published changes that were already there."),
    "pulls": ("log_pulls", "Pieces of robots' logs that were asked for."),
    "pulled": ("changes_pulled", "Changes that came with them."),
    "restored": ("changes_restored", "Changes that took the place of ones damaged on the disk."),
    "failures": ("store_commit_failures", "Commits that the disk did not take."),
}
MERGER = {
    "changes": ("changes_merged", "Changes that were taken into the maps."),
    "verified": ("node_pairs_compared", "Pairs of nodes that were compared."),
    "recognised": ("node_pairs_recognised", "Of these, pairs whose landmarks agreed."),
    "merges": ("merges", "Merges."),
}
COUNTS = {
    "nodes": ("nodes", "Nodes of the merged map."),
    "superseded": ("nodes_superseded", "Of these, nodes that newer ones replace."),
    "maps": ("maps", "Maps in the merge."),
    "set_apart": ("maps_set_apart", "Maps with which the merge fails, or that are copies."),
    "components": ("components", "Parts of the merged map that nothing joins."),
    "links": ("links", "Links between maps."),
    "loops": ("loops", "Links within one map."),
    "refused": ("links_refused", "Links that were found and are not believed."),
    "constraints": ("constraints", "Manual constraints in force."),
}


@dataclass(frozen=True)
class Sources:
    """Where the numbers come from; each is called with every scrape, from any thread.

    Attributes:
        store: path of the store.
        ingest: counters of what came.
        merger: counters of the merger.
        counts: of the merged map, by name.
        held_back: by the quotas since the start, by kind.
        dropped: messages and questions for which the queue of the bus had no room.
        admission: counters of the questions that take long.
        lags: how far the store is behind each robot.
        robots: that are heard of.
        over_quota: robots that are over their quotas now.
        damaged: changes that are damaged on the disk.
        queues: what waits, by the name of the queue.
        failing: whether the disk takes no changes now.
        settled: whether everything that came is merged.
        leads: whether this server leads those that share its store; always, if none do.
        merges_itself: whether it merges all the same, though it does not lead.
        unmerged: for how long the oldest of what came has waited for a merge, s.
    """

    store: Path
    ingest: Callable[[], IngestCounters]
    merger: Callable[[], MergerCounters]
    counts: Callable[[], Mapping[str, int]]
    held_back: Callable[[], Mapping[str, int]]
    dropped: Callable[[], int]
    admission: Callable[[], Mapping[str, int | float]]
    lags: Callable[[], Mapping[str, Lag]]
    robots: Callable[[], Mapping[str, Presence]]
    over_quota: Callable[[], Iterable[str]]
    damaged: Callable[[], int]
    queues: Callable[[], Mapping[str, int]]
    failing: Callable[[], bool]
    settled: Callable[[], bool]
    leads: Callable[[], bool]
    merges_itself: Callable[[], bool]
    unmerged: Callable[[], float]


class Metrics:
    """The Prometheus metrics of one server. Thread-safe."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._ack = self._histogram(
            "ack", "From the receipt of a published change to its acknowledgement.", ACK_BUCKETS
        )
        self._merge = self._histogram("merge", "Time that a merge takes.", MERGE_BUCKETS)
        self._relocalize = self._histogram(
            "relocalize",
            "From a question where a view was taken to its answer.",
            RELOCALIZE_BUCKETS,
            "outcome",
        )
        # Series that begin with their first event have no rate for it.
        for outcome in (*Certainty, FAILED):
            self._relocalize.labels(str(outcome))
        ProcessCollector(registry=self._registry)

    def read(self, sources: Sources) -> None:
        """Read these with every scrape."""
        self._registry.register(_Reader(sources))

    def scrape(self) -> bytes:
        """Everything, in the text format of Prometheus."""
        return generate_latest(self._registry)

    def acknowledged(self, seconds: float) -> None:
        """A change was acknowledged, so long after it came."""
        self._ack.observe(seconds)

    def merged(self, seconds: float) -> None:
        """A merge has taken so long."""
        self._merge.observe(seconds)

    def relocalized(self, seconds: float, done: Future[RelocalizeAnswer]) -> None:
        """A view was looked for so long, with its time in the queue. Refusals are counted elsewhere."""
        error = None if done.cancelled() else done.exception()
        if done.cancelled() or isinstance(error, Busy):
            return
        outcome = FAILED if error is not None else str(done.result().certainty)
        self._relocalize.labels(outcome).observe(seconds)

    def _histogram(self, name: str, words: str, buckets: tuple[float, ...], *labels: str) -> Histogram:
        return Histogram(f"mapweave_{name}_seconds", words, labels, buckets=buckets, registry=self._registry)


class _Reader(Collector):
    """Reads the sources."""

    def __init__(self, sources: Sources) -> None:
        self._sources = sources

    def collect(self) -> Iterator[Metric]:
        s = self._sources
        yield _gauge("build_info", "Version of the server.", {version("mapweave"): 1.0}, "version")
        ingest, merger, counts = s.ingest(), s.merger(), s.counts()
        for field, (name, words) in INGEST.items():
            yield _counter(name, words, getattr(ingest, field))
        for field, (name, words) in MERGER.items():
            yield _counter(name, words, getattr(merger, field))
        for field, (name, words) in COUNTS.items():
            yield _gauge(name, words, float(counts[field]))
        admission = s.admission()
        yield _counter(
            "questions_answered",
            "Questions that take long and were answered.",
            admission["answered"],
        )
        yield self._refusals(ingest, admission)
        queues = {**s.queues(), "questions": admission["open"]}
        yield _gauge("queue_length", "What waits in a queue of the server.", queues, "queue")
        yield _gauge("settled", "Whether everything that came is merged.", float(s.settled()))
        words = "For how long the oldest of what came and is not in the merged map has waited."
        yield _gauge("unmerged_seconds", words, s.unmerged())
        yield _gauge("leads", "Whether this server leads those that share its store.", float(s.leads()))
        words = "Whether this server merges, though another one leads."
        yield _gauge("merges_itself", words, float(s.merges_itself()))
        yield _gauge("store_failing", "Whether the disk takes no changes now.", float(s.failing()))
        yield _gauge("changes_damaged_on_disk", "Changes to be sent again by robots.", float(s.damaged()))
        yield from self._files()
        yield from self._robots()

    def _refusals(self, ingest: IngestCounters, admission: Mapping[str, int | float]) -> Metric:
        """Refusals, by a reason of which there are few."""
        held_back = self._sources.held_back()
        quotas = {f"quota_{what}": held_back.get(what, 0) for what in QUOTAS}
        reasons = {"invalid_change": ingest.refused, "damaged_message": ingest.damaged, **quotas}
        reasons["queue_full"] = self._sources.dropped()
        words = "What the server did not take or answer, by reason."
        return _counter("refusals", words, {**reasons, "busy": admission["busy"]}, "reason")

    def _files(self) -> Iterator[Metric]:
        path = self._sources.store
        files = {name: path.with_name(path.name + suffix) for name, suffix in FILES.items()}
        sizes = {name: float(_size(file)) for name, file in files.items()}
        yield _gauge("file_bytes", "Size of a file of the server.", sizes, "file")
        free = float(shutil.disk_usage(path.parent).free)
        yield _gauge("disk_free_bytes", "Room on the disk of the store.", free)

    def _robots(self) -> Iterator[Metric]:
        """Robots have a label each; the roster bounds their number."""
        lags, robots = self._sources.lags(), self._sources.robots()
        alive = {name: float(one.alive) for name, one in robots.items()}
        yield _gauge("robots_alive", "Robots whose agents are there.", sum(alive.values()))
        yield _gauge("changes_missing", "Changes that are known of and not on the disk.",
                     float(sum(lag.missing for lag in lags.values())))  # fmt: skip
        yield _gauge("lag_max_seconds", "The largest lag of any robot.",
                     max((lag.seconds for lag in lags.values()), default=0.0))  # fmt: skip
        yield _gauge("robot_alive", "Whether the robot's agent is there.", alive, "robot")
        lag = {name: lags.get(name, NO_LAG).seconds for name in robots}
        yield _gauge(
            "robot_lag_seconds", "For how long a change of it is known of and not here.", lag, "robot"
        )
        missing = {name: float(lags.get(name, NO_LAG).missing) for name in robots}
        yield _gauge(
            "robot_changes_missing", "Changes of it that are known of and not here.", missing, "robot"
        )
        unsent = {name: float(one.unsent) for name, one in robots.items()}
        yield _gauge("robot_changes_unacknowledged", "By its own count.", unsent, "robot")
        ages = {name: one.age for name, one in robots.items() if one.age is not None}
        yield _gauge("robot_status_age_seconds", "Since its last status.", ages, "robot")
        over = {*self._sources.over_quota()}
        held_back = {name: float(name in over) for name in robots}
        yield _gauge("robot_over_quota", "Whether something of it is held back now.", held_back, "robot")


QUOTAS = ("changes", "beacons", "maps", "nodes", "questions")
"""Kinds of what quotas hold back."""


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:  # it is not there yet
        return 0
