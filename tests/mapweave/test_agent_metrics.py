"""What Prometheus scrapes from a running agent: against what its robot sensed, and what its page lists."""

import http.client
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from mapweave import Command, MissionKind, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.mission import WhereAmI
from mapweave.agent.pipeline import TickResult
from mapweave.agent.replication.replicator import ReplicationStatus
from mapweave.agent.sensor_health.sensor_monitor import SensorFault
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.errors import NotConnected, SettingsError
from mapweave.processes.agent import AgentOptions
from mapweave.processes.agent_metrics import AgentMetrics, AgentSources
from mapweave.processes.agent_process import run_agent
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus
from tests.agent.conftest import DESCRIPTION
from tests.waiting import eventually, free_port

ROOT = Path(__file__).parents[2]
STATUS = Status("turning", "", 3, 40, Pose2(), False)


class Scrape:
    """Samples by name and labels, and labels by name, as a Prometheus server reads them."""

    def __init__(self, content: bytes) -> None:
        families = list(text_string_to_metric_families(content.decode()))
        samples = [sample for family in families for sample in family.samples]
        self.values = {(sample.name, *sample.labels.values()): sample.value for sample in samples}
        self.labels = {
            re.sub(r"_(bucket|sum|count|created)$", "", sample.name): {*sample.labels} - {"le"}
            for sample in samples
            if sample.name.startswith("mapweave_")
        }

    def __call__(self, name: str, *labels: str) -> float:
        return self.values[f"mapweave_agent_{name}", *labels]


def step(fault: SensorFault | None = None) -> TickResult:
    return TickResult(Command(), (), (), STATUS, fault)


def test_ticks_and_faults_are_counted():
    metrics = AgentMetrics("r0")
    camera = SensorFault("camera", "it is dark")
    for busy, fault in ((0.0, None), (0.01, camera), (0.03, camera), (3.0, None), (0.1, camera)):
        metrics.step(step(fault), busy)
    scrape = Scrape(metrics.scrape())
    assert scrape("ticks_total") == 5 and scrape("tick_seconds_count") == 4
    assert scrape("tick_seconds_sum") == pytest.approx(3.14)
    buckets = {"0.005": 0, "0.01": 1, "0.02": 1, "0.05": 2, "0.1": 3, "1.0": 3, "+Inf": 4}
    assert {bound: scrape("tick_seconds_bucket", bound) for bound in buckets} == buckets
    assert scrape("sensor_faulty", "camera") == 1 and scrape("sensor_faults_total", "camera") == 2
    assert scrape("sensor_faulty", "encoders") == scrape("sensor_faults_total", "encoders") == 0
    metrics.step(step(), 0.0)
    assert Scrape(metrics.scrape())("sensor_faulty", "camera") == 0


def test_the_page_lists_every_metric():
    metrics = AgentMetrics("r0")
    status = AgentStatus(STATUS, 1, "r0", 1, linked=True, placed=2, battery=0.4, skipped=7, traffic=900)
    replication = ReplicationStatus(9, 5, 4, 1, "the disk is full")
    metrics.read(
        AgentSources(
            lambda: status, lambda: replication, lambda: {WhereAmI: 6}, lambda: {"found": 2, "failed": 1},
            lambda: 8, lambda: 3,
        )
    )  # fmt: skip
    scrape = Scrape(metrics.scrape())
    assert scrape("battery_charge") == 0.4 and scrape("nodes") == 3 and scrape("nodes_placed") == 2
    assert scrape("images_skipped_total") == 7 and scrape("network_bytes_total") == 900
    assert scrape("changes_unsaved") == 5 and scrape("changes_unacknowledged") == 4
    assert scrape("saving_fails") == scrape("changes_refused") == scrape("server_in_reach") == 1
    assert scrape("server_arrivals_total") == 3
    assert scrape("questions_total", "place") == 6 and scrape("questions_total", "route") == 0
    assert scrape("answers_refuted_total") == 8
    assert scrape("relocalizations_total", "found") == 2 and scrape("relocalizations_total", "failed") == 1
    page = (ROOT / "docs" / "monitoring.md").read_text()
    listed = re.findall(r"^\| `(mapweave_agent_\w+)` \|([^|]*)\|", page, re.MULTILINE)
    assert {name: {*re.findall(r"`(\w+)`", more)} for name, more in listed} == scrape.labels


class Still:
    """A robot that stands before noise, and tells its battery."""

    def __init__(self) -> None:
        size = (DESCRIPTION.camera.height, DESCRIPTION.camera.width)
        self._image = np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8)
        self.sensed = 0

    def describe(self) -> RobotDescription:
        return replace(DESCRIPTION, tick=0.02)

    def sense(self) -> Observation | None:
        self.sensed += 1
        threading.Event().wait(0.02)
        return Observation(self.sensed * 20_000_000, Odometry(0.0, 0.0), self._image, battery=0.75)

    def act(self, command: Command) -> Command:
        return command

    def close(self) -> None:
        pass


@contextmanager
def running(folder: Path, port: int) -> Iterator[Still]:
    """An agent with metrics, and no server."""
    bus, stop = ZenohBus(BusSettings(endpoints=(f"tcp/127.0.0.1:{free_port()}",))), threading.Event()
    robot = Still()
    options = AgentOptions("r0", folder, mission=MissionKind.CARRIED, patience=0.0, metrics=port)
    run = (robot, bus, Keys("f"), AgentSettings(), options, stop)
    agent = threading.Thread(target=run_agent, args=run)
    agent.start()
    try:
        yield robot
    finally:
        stop.set()
        agent.join()
        bus.close()


def scraped(port: int) -> Scrape:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.request("GET", "/metrics")
        return Scrape(connection.getresponse().read())
    finally:
        connection.close()


def answers(port: int) -> bool:
    try:
        return "mapweave_agent_nodes" in scraped(port).labels
    except OSError:
        return False


def test_a_running_agent_is_scraped_and_waits_for_no_one(tmp_path):
    port = free_port()
    with running(tmp_path, port) as robot:
        eventually(lambda: answers(port))
        # One that connects and says nothing, and one that takes nothing of its answer.
        with (
            socket.create_connection(("127.0.0.1", port)),
            socket.create_connection(("127.0.0.1", port)) as deaf,
        ):
            deaf.sendall(b"GET /metrics HTTP/1.0\r\nHost: localhost\r\n\r\n")
            before = scraped(port)("ticks_total")
            eventually(lambda: scraped(port)("ticks_total") > before + 20)
        scrape = scraped(port)
        assert scrape("ticks_total") <= robot.sensed
        assert 0 < scrape("tick_seconds_count") < robot.sensed
        assert scrape("battery_charge") == 0.75 and scrape("info", "r0", "0.1.0") == 1
        assert scrape("mission_kind", "carried") == scrape("mission_state", "running") == 1
        assert scrape("mission_kind", "explore") == scrape("server_in_reach") == 0
    with pytest.raises(ConnectionRefusedError):
        scraped(port)


@pytest.mark.parametrize(("headers", "status"), [
    ({}, 200),
    ({"Host": "localhost:9101"}, 200),
    ({"Host": "rebound.example:9101"}, 403),
    ({"Origin": "http://evil.example"}, 403),
    ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}, 403),
])  # fmt: skip
def test_pages_of_other_sites_are_refused(headers: dict[str, str], status: int):
    """Also one whose name an attacker points at this machine (DNS rebinding)."""
    close = AgentMetrics("r0").serve(port := free_port())
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.request("GET", "/metrics", headers=headers)
        answer = connection.getresponse()
        assert answer.status == status
        assert (b"mapweave_agent_info" in answer.read()) == (status == 200)
    finally:
        connection.close()
        close()


def test_a_port_that_cannot_be_had(port: int):
    with pytest.raises(NotConnected, match=rf"127.0.0.1:{port} .*in use\); choose another port$"):
        AgentMetrics("r0").serve(port)
    for wrong in (0, -1, 70_000):
        with pytest.raises(SettingsError, match=f"--metrics {wrong}: give a port"):
            AgentMetrics("r0").serve(wrong)
