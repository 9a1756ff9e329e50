"""What Prometheus scrapes from a real server, against what went over the bus and lies on the disk."""

import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families

from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.web import Web
from mapweave.wire.log_messages import Head, Mark
from mapweave.wire.messages import encode
from tests.mapserver.http.client import ask
from tests.mapserver.test_set_apart import KEYS, Fleet, serving, sound_logs
from tests.waiting import eventually

FIRST, SECOND = sound_logs().items()
LOG_ID = 7


class Scrape:
    """Samples by name and labels, as a Prometheus server reads them."""

    def __init__(self, fleet: Fleet) -> None:
        self.families: list[Metric] = list(text_string_to_metric_families(fleet.server.metrics().decode()))
        self.samples = {
            (sample.name, *sample.labels.values()): sample.value
            for family in self.families
            for sample in family.samples
        }

    def __call__(self, name: str, *labels: str) -> float:
        return self.samples[f"mapweave_{name}", *labels]


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    with serving(tmp_path / "s0.sqlite") as fleet:
        fleet.acks_of("r0")
        fleet.acks_of("r1")
        yield fleet


def publish(fleet: Fleet, map_id: MapId, log: list[bytes], *but: int) -> None:
    """All changes of a log, but some that are lost."""
    for sequence, message in enumerate(log, 1):
        if sequence not in but:
            fleet.bus.publish(KEYS.change(map_id), message, Mark(sequence, LOG_ID).encode())


def acknowledged(fleet: Fleet, map_id: MapId, watermark: int) -> None:
    eventually(lambda: any(ack.map == map_id and ack.watermark == watermark for ack in fleet.acks))


def test_counts_are_those_of_the_bus_and_of_the_disk(tmp_path):
    path = tmp_path / "s0.sqlite"
    sent = [message for _, log in (FIRST, SECOND) for message in (*log, *log[:2])]
    with serving(path) as fleet:
        for map_id, log in (FIRST, SECOND):
            fleet.acks_of(map_id.agent)
            publish(fleet, map_id, log)
            publish(fleet, map_id, log[:2])
            acknowledged(fleet, map_id, len(log))
        eventually(lambda: Scrape(fleet)("changes_doubled_total") == 4)
        assert fleet.server.settle(30)
        answers = fleet.where()
        eventually(lambda: Scrape(fleet)("settled") == 1)
        scrape, merged = Scrape(fleet), fleet.server.merged()
    with closing(sqlite3.connect(path)) as rows:
        (kept,) = rows.execute("SELECT count(*) FROM change").fetchone()
    assert kept == len(sent) - 4 == scrape("changes_taken_total") == scrape("ack_seconds_count")
    assert scrape("changes_received_total") == len(sent)
    assert scrape("changes_received_bytes_total") == sum(map(len, sent))
    assert scrape("nodes") == len(merged.poses) and scrape("links") == len(merged.links) > 0
    assert scrape("components") == 1 and scrape("merges_total") >= 1
    assert scrape("merge_seconds_count") >= scrape("merges_total")
    outcomes = Counter(str(answer.certainty) for answer in answers)
    assert {outcome: scrape("relocalize_seconds_count", outcome) for outcome in outcomes} == outcomes
    assert all(0.0 < scrape("relocalize_seconds_sum", outcome) < 60.0 for outcome in outcomes)
    size = scrape("file_bytes", "log") + scrape("file_bytes", "write_ahead_log")
    assert size > sum(map(len, sent)) / 2 and scrape("disk_free_bytes") > 0
    assert scrape("queue_length", "ingest") == scrape("lag_max_seconds") == scrape("store_failing") == 0


def test_a_gap_and_a_silent_robot_are_seen_by_name(fleet: Fleet):
    map_id, log = FIRST
    alive = fleet.bus.announce(KEYS.agent_alive(map_id))
    status = AgentStatus(Status("mapping", "", 3, 0, Pose2(), False), 1, "r0", 1, unsent=len(log) - 1)
    fleet.bus.publish(KEYS.agent_status("r0"), encode(status))
    publish(fleet, map_id, log, 2)
    acknowledged(fleet, map_id, 1)
    eventually(lambda: Scrape(fleet)("robot_changes_missing", "r0") == len(log) - 1)
    first = Scrape(fleet)
    assert first("robot_alive", "r0") == first("robots_alive") == 1
    assert first("robot_changes_unacknowledged", "r0") == len(log) - 1
    eventually(lambda: Scrape(fleet)("robot_lag_seconds", "r0") > first("robot_lag_seconds", "r0") > 0.0)
    assert Scrape(fleet)("lag_max_seconds") >= Scrape(fleet)("robot_lag_seconds", "r0") - 0.5
    fleet.tell(map_id, log)
    alive.close()
    eventually(lambda: Scrape(fleet)("robot_alive", "r0") == 0)
    closed = Scrape(fleet)
    assert closed("robot_lag_seconds", "r0") == closed("changes_missing") == 0
    assert closed("changes_pulled_total") > 0 and closed("robot_status_age_seconds", "r0") > 0


def test_what_found_the_queue_of_the_bus_full_is_counted(fleet: Fleet, monkeypatch):
    assert Scrape(fleet)("refusals_total", "queue_full") == 0
    dispatcher = fleet.server._bus._dispatcher
    monkeypatch.setattr(dispatcher, "_put", lambda *_, **__: False)
    fleet.bus.publish(KEYS.head(FIRST[0]), b"\xc1")
    assert fleet.bus.ask(KEYS.robots("s0"), b"", 5.0)[0].error
    monkeypatch.undo()
    assert Scrape(fleet)("refusals_total", "queue_full") == 2


def test_refusals_have_few_reasons(fleet: Fleet):
    map_id, log = FIRST
    names = {sample for sample in Scrape(fleet).samples if sample[0] == "mapweave_refusals_total"}
    fleet.bus.publish(KEYS.change(map_id), b"\xc1", Mark(1, LOG_ID).encode())
    fleet.bus.publish(KEYS.head(map_id), b"\xc1")
    eventually(lambda: Scrape(fleet)("refusals_total", "damaged_message") == 2)
    publish(fleet, map_id, log[:1])
    acknowledged(fleet, map_id, 1)
    limit = fleet.server._quotas.settings.maps
    for epoch in range(2, limit + 12):
        fleet.bus.publish(KEYS.head(MapId("r0", epoch)), Head(LOG_ID, 1).encode())
    eventually(lambda: Scrape(fleet)("refusals_total", "quota_maps") == 11)
    scrape = Scrape(fleet)
    assert {sample for sample in scrape.samples if sample[0] == "mapweave_refusals_total"} == names
    for family in scrape.families:
        assert family.documentation, family.name
        labels = {label for sample in family.samples for label in sample.labels}
        assert labels <= {"robot", "reason", "outcome", "queue", "file", "version", "le"}, family.name


def test_it_is_served_over_http(fleet: Fleet):
    with Web(("127.0.0.1", 0), fleet.server) as web:
        status, headers, content = ask(web, "GET", "/metrics")
        assert status == 200 and headers["Content-Type"].startswith("text/plain; version=0.0.4")
        assert {family.name for family in text_string_to_metric_families(content.decode())} >= {
            "mapweave_ack_seconds", "mapweave_changes_taken", "process_resident_memory_bytes",
        }  # fmt: skip
