"""A robot on an older copy of its journal: its new changes have numbers of others that the server has."""

import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.acknowledgements import Acknowledgements
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.mapserver.log.test_older_store import Robot, contents
from tests.mapserver.log.test_store import node_put
from tests.waiting import eventually

MAP = MapId("r0", 1)
PATIENCE = 60.0


@pytest.fixture
def put_back(tmp_path: Path) -> Path:
    """A folder with a server's store that has nine changes, and a robot's journal of which five are left."""
    hub, journal, before = MemoryHub(), tmp_path / "r0.sqlite", tmp_path / "before.sqlite"
    store = SqliteStore(tmp_path / "s0.sqlite")
    with closing(MemoryBus(hub)) as bus, closing(store), closing(serving(bus, store)):
        with closing(Robot(hub, tmp_path)) as robot:
            robot.send(*(node_put(k) for k in range(1, 6)))
        shutil.copy(journal, before)
        with closing(Robot(hub, tmp_path)) as robot:
            robot.send(*(node_put(k) for k in range(6, 10)))
    shutil.copy(before, journal)
    return tmp_path


def serving(bus: MemoryBus, store: SqliteStore) -> Ingest:
    return Ingest(bus, Keys("fleet"), store, "s0", lambda change: None)


@contextmanager
def unchanged(hub: MemoryHub, folder: Path) -> Iterator[Ingest]:
    """A server on that store, which has at the end what it had before."""
    with closing(SqliteStore(folder / "s0.sqlite")) as store:
        had = contents(change.body for change in store.replay(MAP))
        with closing(MemoryBus(hub)) as bus, closing(serving(bus, store)) as ingest:
            yield ingest
            assert contents(change.body for change in store.replay(MAP)) == had
            assert store.watermark(MAP) == 9


@pytest.mark.parametrize("away", [False, True], ids=["the server is there", "the network comes later"])
def test_what_a_robot_maps_behind_an_older_journal_does_not_pass_for_what_the_server_has(
    put_back: Path, hub: MemoryHub, away: bool
):
    with unchanged(hub, put_back) as ingest:
        with closing(Robot(hub, put_back)) as robot:
            link = robot.replicator
            if away:
                hub.cut(robot._bus)
            else:
                eventually(lambda: "begin a fresh map" in link.status().failure, PATIENCE)
            for number in range(20, 30):
                link.submit([node_put(number)], 1)
                assert link.flush(PATIENCE)
            assert link.status().newest == 15
            if away:
                hub.restore(robot._bus)
            eventually(lambda: "begin a fresh map" in link.status().failure, PATIENCE)
            asked = ingest.counters().pulls
            assert not link.wait_acknowledged(1.0)
            assert link.status().unacknowledged == 10 and robot.journal.acknowledged(MAP) == {"s0": 5}
        with closing(Robot(hub, put_back)) as robot:
            assert "begin a fresh map" in robot.replicator.status().failure, "also after it starts again"
            assert not robot.replicator.wait_acknowledged(1.0)
            robot.journal.open_map(2)
            with closing(Replicator(robot._bus, Keys("fleet"), robot.journal, MapId("r0", 2))) as fresh:
                fresh.submit([NodePut(replace(node_put(1).node, id=NodeId("r0", 2, 1)))], 1)
                assert fresh.wait_acknowledged(PATIENCE) and not fresh.status().failure
        assert asked <= 2


@pytest.mark.parametrize("count", [4, 10], ids=["as many as were lost", "more than were lost"])
def test_so_is_what_was_mapped_without_a_network_before_the_last_start(
    put_back: Path, hub: MemoryHub, count: int
):
    """All that is on the disk may have left before the start: the server says which change it has."""
    with closing(Robot(MemoryHub(), put_back)) as robot:
        robot.replicator.submit([node_put(number) for number in range(20, 20 + count)], 1)
        assert robot.replicator.flush(PATIENCE) and robot.journal.head(MAP) == 5 + count
    with unchanged(hub, put_back), closing(Robot(hub, put_back)) as robot:
        eventually(lambda: "begin a fresh map" in robot.replicator.status().failure, PATIENCE)
        assert not robot.replicator.wait_acknowledged(1.0)


def test_so_is_what_follows_while_acknowledgements_that_compare_are_lost(
    put_back: Path, hub: MemoryHub, monkeypatch
):
    """As many changes are there as were lost: the next number is the server's next one, too."""
    acknowledge = Acknowledgements.acknowledge

    def lose(acks: Acknowledgements, agent_log: AgentLog, compared: bool = False) -> None:
        if not compared:
            acknowledge(acks, agent_log)

    monkeypatch.setattr(Acknowledgements, "acknowledge", lose)
    with closing(Robot(MemoryHub(), put_back)) as robot:
        robot.replicator.submit([node_put(number) for number in range(20, 24)], 1)
        assert robot.replicator.flush(PATIENCE) and robot.journal.head(MAP) == 9
    with unchanged(hub, put_back), closing(Robot(hub, put_back)) as robot:
        robot.replicator.submit([node_put(24)], 1)
        eventually(lambda: "begin a fresh map" in robot.replicator.status().failure, PATIENCE)
        assert robot.replicator.status().unacknowledged == 5


def test_a_robot_that_has_lost_nothing_is_acknowledged_what_it_did_not_know(put_back: Path, hub: MemoryHub):
    """Acknowledgements were lost: its server has the same changes by their numbers."""
    with closing(Robot(MemoryHub(), put_back)) as robot:
        robot.replicator.submit([node_put(number) for number in range(6, 12)], 1)
        assert robot.replicator.flush(PATIENCE)
    with (
        closing(SqliteStore(put_back / "s0.sqlite")) as store,
        closing(serving(MemoryBus(hub), store)),
        closing(Robot(hub, put_back)) as robot,
    ):
        assert robot.replicator.wait_acknowledged(PATIENCE)
        assert robot.journal.acknowledged(MAP) == {"s0": 11} and not robot.replicator.status().failure
