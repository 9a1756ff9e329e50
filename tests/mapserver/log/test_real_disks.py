"""Disks that are really full or read-only: small file systems in memory, which only this test sees."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.disks import own_mounts

pytestmark = pytest.mark.slow

PROGRAM = """
import json, logging, sys
from pathlib import Path
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import ReplicationSettings, Replicator
from mapweave.hybridmap.change import NodeRetired
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.ingest_settings import IngestSettings
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.disks import empty, fill, make_read_only, mount
from tests.waiting import eventually

root, said = Path(sys.argv[1]), {}
logging.basicConfig(filename=root / "log", level=logging.WARNING, format="%(message)s")

def bodies(first, last):
    return [NodeRetired(NodeId("r0", 1, number)) for number in range(first, last + 1)]

robot, server = root / "robot", root / "server"
for folder in (robot, server):
    mount(folder, "16m")
hub, keys = MemoryHub(), Keys("fleet")
bus, server_bus = MemoryBus(hub), MemoryBus(hub)
store = SqliteStore(server / "s0.sqlite")
ingest = Ingest(server_bus, keys, store, "s0", lambda change: None, IngestSettings(retry_interval=0.1))
journal = Journal(robot / "r0.sqlite", "r0")
settings = ReplicationSettings(beacon_interval=0.05, retry_interval=0.1)
agent = Replicator(bus, keys, journal, journal.open_map(1), ("s0",), settings)
agent.submit(bodies(1, 100), 0)
assert agent.wait_acknowledged(30)

fill(robot)
count = 100
while not agent.status().failure:
    # What SQLite has reserved already still takes some.
    agent.submit(bodies(count + 1, count + 500), 0)
    count += 500
    agent.flush(0.1)
said["agent full"] = agent.status().failure
said["waiting"] = agent.status().waiting
empty(robot)
assert agent.flush(30) and agent.wait_acknowledged(30)
said["agent after"] = agent.status().failure

fill(server)
while not ingest.failure:
    agent.submit(bodies(count + 1, count + 500), 0)
    count += 500
    agent.wait_acknowledged(0.2)
said["server full"] = ingest.failure
said["unacknowledged"] = agent.unacknowledged()
acknowledged = journal.acknowledged(MapId("r0", 1))["s0"]
said["kept"] = store.watermark(MapId("r0", 1)) >= acknowledged
empty(server)
assert agent.wait_acknowledged(30)
said["server after"] = ingest.failure
said["same"] = [c.sequence for c in store.replay(MapId("r0", 1))] == list(range(1, count + 1))
lines = (root / "log").read_text().splitlines()
said["lines"] = [line for line in lines if "full" in line]
said["room again"] = [line for line in lines if "has room again" in line]
agent.close()
ingest.close()
journal.close()
store.close()

for name, folder, opens in (
    ("journal", robot, lambda: Journal(robot / "r0.sqlite", "r0")),
    ("store", server, lambda: SqliteStore(server / "s0.sqlite")),
    ("new store", server, lambda: SqliteStore(server / "s1.sqlite")),
):
    make_read_only(folder)
    try:
        opens()
    except InvalidFile as error:
        said[name] = str(error)
# A map on a read-only disk can be looked at.
reader = Journal(robot / "r0.sqlite")
said["read"] = reader.head(MapId("r0", 1)) == count
reader.close()
mount(root / "full", "8k")
fill(root / "full")
try:
    SqliteStore(root / "full" / "s0.sqlite")
except InvalidFile as error:
    said["begun full"] = str(error)
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """What agent and server have said on disks that were full, and then read-only."""
    command = [*own_mounts(), sys.executable, "-c", PROGRAM, str(tmp_path_factory.mktemp("disks"))]
    root = Path(__file__).parents[3]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=root, env=dict(os.environ))
    assert ran.returncode == 0, ran.stderr
    return dict(json.loads(ran.stdout))


def test_on_a_full_disk_a_robot_keeps_its_changes_in_memory_and_goes_on(said: dict[str, object]):
    assert "agent journal: the disk is full" in str(said["agent full"])
    assert int(str(said["waiting"])) > 0
    assert said["agent after"] == ""


def test_on_a_full_disk_a_server_acknowledges_nothing_more_and_loses_nothing(said: dict[str, object]):
    assert "map store: the disk is full" in str(said["server full"])
    assert int(str(said["unacknowledged"])) > 0
    assert (said["kept"], said["server after"], said["same"]) == (True, "", True)


def test_a_full_disk_is_one_line_and_so_is_that_it_has_room(said: dict[str, object]):
    for kind in ("lines", "room again"):
        lines = said[kind]
        assert isinstance(lines, list)
        assert len(lines) == 2, lines
        assert "robot/r0.sqlite: " in lines[0] and "server/s0.sqlite: " in lines[1]


@pytest.mark.parametrize("name", ["journal", "store", "new store"])
def test_a_read_only_disk_is_named(said: dict[str, object], name: str):
    assert "the disk is read-only" in str(said[name])
    assert "\n" not in str(said[name])


def test_a_map_on_a_read_only_disk_can_be_read(said: dict[str, object]):
    assert said["read"] is True


def test_a_disk_that_is_full_at_the_start_is_named(said: dict[str, object]):
    assert "the disk is full" in str(said["begun full"])
