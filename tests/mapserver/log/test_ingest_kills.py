"""Real processes over Zenoh that are really killed: the router with the server in it, and the agent."""

import socket
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.codec import encode_change

CHANGES = 400

SERVER = """
import sys, time
from pathlib import Path
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus

path, endpoint = sys.argv[1:]
bus = ZenohBus(BusSettings(mode="router", listen=(endpoint,)))
store = SqliteStore(Path(path))
print("up", flush=True)
ingest = Ingest(bus, Keys(), store, "s0", lambda change: print(change.sequence, flush=True))
sys.stdin.read()
ingest.close()
bus.close()
store.close()
"""

AGENT = """
import sys, time
from pathlib import Path
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus

path, endpoint, total = sys.argv[1:]
bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
journal = Journal(Path(path), "r0")
map_id = journal.open_map(1)
print("up", flush=True)
print(journal.head(map_id), flush=True)
replicator = Replicator(bus, Keys(), journal, map_id, ("s0",))
pose, ends = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01), (NodeId(*map_id, 1), NodeId(*map_id, 2))
for number in range(journal.head(map_id) + 1, int(total) + 1):
    replicator.submit([EdgePut(Edge(NodeId(*map_id, number), *ends, pose, EdgeKind.MAPPED))], number)
    if number % 5 == 0:
        assert replicator.flush(30)
        print(number, flush=True)
    time.sleep(0.005)
assert replicator.wait_acknowledged(60), replicator.status()
print("acknowledged", flush=True)
replicator.close()
bus.close()
journal.close()
"""


class Life:
    """A process from its start to its end, and its output."""

    def __init__(self, program: str, log: Path, *arguments: str) -> None:
        self.log = log
        with log.open("w") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-c", program, *arguments], stdin=subprocess.PIPE, stdout=out
            )
        while "up" not in self.said():
            assert self.process.poll() is None, "it ended at once"
            time.sleep(0.01)

    def said(self) -> list[str]:
        # The last line may be torn by the kill.
        return [
            line.strip() for line in self.log.read_text().splitlines(keepends=True) if line.endswith("\n")
        ]

    def numbers(self) -> list[int]:
        return [int(line) for line in self.said() if line.isdigit()]

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()

    def finish(self) -> None:
        self.process.communicate(timeout=120)
        assert self.process.returncode == 0


@pytest.mark.slow
def test_nothing_is_lost_when_processes_are_killed(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    store_path, journal_path = tmp_path / "store", tmp_path / "journal"

    def start_server(life: int) -> Life:
        return Life(SERVER, tmp_path / f"server{life}", str(store_path), endpoint)

    def start_agent(life: int) -> Life:
        return Life(AGENT, tmp_path / f"agent{life}", str(journal_path), endpoint, str(CHANGES))

    random = np.random.default_rng(time.time_ns())
    servers, agents = [start_server(0)], [start_agent(0)]
    try:
        for victim in random.permutation(["server", "agent", "server"]):
            time.sleep(random.uniform(0.1, 0.5))
            if victim == "server":
                servers[-1].kill()
                servers.append(start_server(len(servers)))
            else:
                agents[-1].kill()
                agents.append(start_agent(len(agents)))
        agents[-1].finish()
        assert "acknowledged" in agents[-1].said()
        servers[-1].finish()
    finally:
        for life in (*servers, *agents):
            if life.process.poll() is None:
                life.kill()

    map_id = MapId("r0", 1)
    journal, store = Journal(journal_path, "r0"), SqliteStore(store_path)
    kept = journal.changes(map_id, 1, 2 * CHANGES)
    assert [change.sequence for change in kept] == list(range(1, CHANGES + 1))
    assert [change.body.edge.id.number for change in kept] == list(range(1, CHANGES + 1))  # type: ignore[union-attr]
    assert [encode_change(c) for c in store.replay(map_id)] == [encode_change(c) for c in kept]
    assert store.refused() == 0
    journal.close()
    store.close()
    for before, after in pairwise(agents):
        assert before.numbers()[-1] <= after.numbers()[0], "what was flushed before a kill is kept"
    for life in servers:
        assert life.numbers() == list(range(1, len(life.numbers()) + 1)), "in order, once in each life"
