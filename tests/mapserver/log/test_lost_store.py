"""A store that is deleted under the running server: it is said, and robots send everything again."""

from pathlib import Path

import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import ReplicationSettings, Replicator
from mapweave.hybridmap.change import ChangeBody, NodeRetired
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.waiting import eventually

KEYS = Keys("fleet")
MAP = MapId("r0", 1)


def bodies(first: int, last: int) -> list[ChangeBody]:
    return [NodeRetired(NodeId(*MAP, number)) for number in range(first, last + 1)]


def delete(path: Path) -> None:
    for part in path.parent.glob(f"{path.name}*"):
        part.unlink()


@pytest.mark.parametrize("again", [False, True], ids=["deleted", "replaced"])
def test_a_store_that_is_deleted_takes_nothing_more(tmp_path, again: bool):
    path = tmp_path / "s0.sqlite"
    store = SqliteStore(path)
    store.put_result("x", b"1")
    delete(path)
    if again:
        path.write_bytes(b"")
    with pytest.raises(InvalidFile, match="deleted or replaced under the running program"):
        store.put_result("x", b"2")
    store.close()


def test_a_store_that_was_moved_takes_changes_when_it_is_put_back(tmp_path):
    path = tmp_path / "s0.sqlite"
    store = SqliteStore(path)
    path.rename(tmp_path / "elsewhere")
    with pytest.raises(InvalidFile, match="deleted or replaced"):
        store.put_result("x", b"1")
    (tmp_path / "elsewhere").rename(path)
    store.put_result("x", b"2")
    known = store.id
    store.close()
    again = SqliteStore(path)
    assert again.result("x") == b"2" and again.id == known
    again.close()


def test_a_server_with_a_deleted_store_reports_it_and_gets_everything_again(tmp_path):
    hub, path = MemoryHub(), tmp_path / "s0.sqlite"
    bus, journal = MemoryBus(hub), Journal(tmp_path / "journal.sqlite", "r0")
    robot = Replicator(
        bus, KEYS, journal, journal.open_map(1), ("s0",), ReplicationSettings(beacon_interval=0.05)
    )
    server_bus = MemoryBus(hub)
    with MapServer(server_bus, KEYS, path, "s0") as server:
        robot.submit(bodies(1, 5), 0)
        assert robot.wait_acknowledged(30)
        delete(path)
        robot.submit(bodies(6, 7), 0)
        eventually(lambda: "deleted or replaced" in str(server.status()["event"]))
        assert not robot.wait_acknowledged(0.5)
        assert robot.unacknowledged() == 2
    with MapServer(server_bus, KEYS, path, "s0"):
        assert robot.wait_acknowledged(30)
        # Acknowledged again, not because it was before.
        eventually(lambda: robot.unacknowledged() == 0)
    kept = SqliteStore(path)
    eventually(lambda: kept.watermark(MAP) == 7)
    assert [change.sequence for change in kept.replay(MAP)] == list(range(1, 8))
    kept.close()
    robot.close()
    journal.close()
    bus.close()
    server_bus.close()
