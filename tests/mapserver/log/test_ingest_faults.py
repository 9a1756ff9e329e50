"""Agents and a server on a bus that drops, doubles, delays and reorders, restarted at random moments."""

import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import ReplicationSettings, Replicator
from mapweave.hybridmap.change import Change, EdgePut
from mapweave.hybridmap.ids import NodeId
from mapweave.mapserver.log.agent_log import PullSettings
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.ingest_settings import IngestSettings
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub, MessageFaults
from tests.wire.conftest import sample_edge

KEYS = Keys("fleet")
AGENT = ReplicationSettings(beacon_interval=0.02, answer_bytes=1500)
SERVER = IngestSettings(
    PullSettings(grace=0.005, first_pause=0.01, longest_pause=0.05, ahead=20), ask_timeout=0.5
)


class Robot:
    """An agent's journal and replicator, which can be stopped and started."""

    def __init__(self, hub: MemoryHub, folder: Path, name: str) -> None:
        self.hub, self.folder, self.name = hub, folder, name
        self.epoch: int | None = None
        self.numbers = itertools.count(1)
        self.start()

    def start(self) -> None:
        self.bus = MemoryBus(self.hub)
        self.journal = Journal(self.folder / self.name, self.name)
        self.map = self.journal.open_map(self.epoch)
        self.epoch = self.map.epoch
        self.replicator = Replicator(self.bus, KEYS, self.journal, self.map, ("s0",), AGENT)

    def stop(self) -> None:
        self.replicator.close()
        self.bus.close()
        self.journal.close()

    def work(self, count: int) -> None:
        for _ in range(count):
            number = next(self.numbers)
            edge = replace(sample_edge(0, self.map), id=NodeId(*self.map, number))
            self.replicator.submit([EdgePut(edge)], number)


class Server:
    """A store and an ingest, which can be stopped and started; remembers what was passed on in each life."""

    def __init__(self, hub: MemoryHub, path: Path) -> None:
        self.hub, self.path = hub, path
        self.lives: list[list[Change]] = []
        self.start()

    def start(self) -> None:
        self.lives.append([])
        self.bus = MemoryBus(self.hub)
        self.store = SqliteStore(self.path)
        self.ingest = Ingest(self.bus, KEYS, self.store, "s0", self.lives[-1].append, SERVER)

    def stop(self) -> None:
        self.ingest.close()
        self.bus.close()
        self.store.close()


steps = st.lists(
    st.sampled_from(
        ["work", "work", "work", "restart robot", "fresh map", "restart server", "cut", "restore"]
    ),
    min_size=3,
    max_size=10,
)
shares = st.sampled_from([0.0, 0.2, 0.6])


@pytest.mark.slow
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(steps, st.builds(MessageFaults, shares, shares, shares, st.integers(1, 30)), st.integers(0, 2**32 - 1))
def test_the_store_becomes_the_journals(tmp_path_factory, steps: list[str], faults: MessageFaults, seed: int):
    folder = tmp_path_factory.mktemp("faults")
    hub = MemoryHub()
    server = Server(hub, folder / "store")
    robots = [Robot(hub, folder, name) for name in ("r0", "r1")]
    random = np.random.default_rng(seed)
    hub.disturb(faults, random)
    maps = {robot.map for robot in robots}
    for step in steps:
        robot = robots[random.integers(2)]
        match step:
            case "work":
                robot.work(int(random.integers(1, 40)))
            case "restart robot":
                robot.stop()
                robot.start()
            case "fresh map":
                robot.stop()
                robot.epoch = None
                robot.start()
                maps.add(robot.map)
            case "restart server":
                server.stop()
                server.start()
            case "cut":
                hub.cut(server.bus)
            case "restore":
                hub.restore(server.bus)
        time.sleep(float(random.choice([0.0, 0.002, 0.02])))
    # The faults go on: only the cut is mended, so that there is a way at all.
    hub.restore(server.bus)
    for robot in robots:
        assert robot.replicator.wait_acknowledged(60), "never complete"
    hub.calm()
    server.stop()
    server.start()
    for robot in robots:
        for map in (map for map in maps if map.agent == robot.name):
            journal = [encode_change(c) for c in robot.journal.changes(map, 1, robot.journal.head(map))]
            stored = [encode_change(change) for change in server.store.replay(map)]
            assert stored == journal
            assert len(journal) == server.store.watermark(map)
    for life in server.lives:
        for map in maps:
            passed_on = [change.sequence for change in life if change.map == map]
            assert passed_on == list(range(1, len(passed_on) + 1)), "once and in order, from the beginning"
    assert server.store.refused() == 0
    for robot in robots:
        robot.stop()
    server.stop()
