"""A merge for which the memory does not suffice: the last map stays, and it is tried again."""

import json
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.merge_worker import MergeWorker
from mapweave.mapserver.merging import merge_retry
from mapweave.mapserver.merging.merge_retry import FIRST, LONGEST, SUFFIX, MergeRetry
from mapweave.mapserver.schedule import LiveSchedule
from mapweave.mapserver.server import MapServer
from mapweave.wire.codec import encode_change
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.maps import looked_around, numbered
from tests.clock import Clock
from tests.mapserver.log.acknowledged_fleet import AGENT, KEYS
from tests.mapserver.log.test_front_servers import logs_of
from tests.waiting import eventually

R0, R1 = MapId("r0", 1), MapId("r1", 1)
SHORT_OF_MEMORY = """
import json, logging, resource, sys
import numpy as np
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver import merge_worker
from mapweave.mapserver.merge_worker import MergeWorker
from mapweave.mapserver.merging import merge_retry
from mapweave.mapserver.merging.merge_pipeline import MergePipeline
from mapweave.mapserver.schedule import LiveSchedule
from synthetic.maps import looked_around, numbered
from tests.clock import Clock
from tests.waiting import eventually

logging.basicConfig(format="%(message)s")
merge_retry.FIRST = merge_worker.RETRY = 0.2
real = MergePipeline.merged
MB = 2**20

def merged(self, maps, *arguments):
    # What a large map takes: only merges of all three maps are large here.
    if len(maps) > 2:
        np.empty(1024 * MB, np.uint8)
    return real(self, maps, *arguments)

MergePipeline.merged = merged
logs = looked_around([MapId(f"r{k}", 1) for k in range(3)], 3)
worker = MergeWorker(LiveSchedule(), 1.0)
worker.start()

def take(which):
    for change in numbered(which, logs[which]):
        worker.take(change)

def nodes():
    return len(worker.answers.merged.poses)

for which in list(logs)[:2]:
    take(which)
eventually(lambda: worker.settled and nodes() == 8)
with open("/proc/self/statm") as pages:
    size = int(pages.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + 512 * MB, -1))
take(list(logs)[2])
eventually(lambda: merge_retry.SHORT in worker.event)
before = nodes(), len(worker.answers.merged.set_apart), worker.event
resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
eventually(lambda: nodes() == 12)
apart = worker.answers.merged.set_apart
worker.close()
print(json.dumps([before, len(apart), worker.delay]))
"""
KILLED = """
import os, signal, sys
from pathlib import Path
from mapweave.mapserver.merging.merge_retry import MergeRetry
with MergeRetry(Path(sys.argv[1])).attempt():
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_the_last_map_stays_and_no_map_is_blamed_where_memory_is_short():
    """With a real limit of the process: maps were set apart one by one, until they changed."""
    done = subprocess.run(
        [sys.executable, "-c", SHORT_OF_MEMORY], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    (nodes, apart, event), apart_later, delay = json.loads(done.stdout)
    assert (nodes, apart) == (8, 0)
    assert "merging begins again after" in event and "the map lacks what came since" in event
    assert (apart_later, delay) == (0, "")
    lines = [line for line in done.stderr.splitlines() if "memory" in line]
    assert lines and "Traceback" not in done.stderr
    assert all(line.startswith(f"{merge_retry.SHORT}: merging begins again after") for line in lines)


def test_it_is_tried_less_and_less_often():
    clock = Clock()
    retry = MergeRetry(None, clock)
    pauses = []
    for _ in range(9):
        retry.short()
        pauses.append(retry.pause)
        clock.now += retry.pause
    assert pauses[:3] == [FIRST, 2 * FIRST, 4 * FIRST] and pauses[-1] == LONGEST == max(pauses)
    retry.succeeded()
    retry.short()
    assert retry.pause == FIRST


def killed(path: Path) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(path)], timeout=60, check=False)


def test_a_process_that_is_killed_while_it_merges_is_noticed(tmp_path, caplog):
    path = tmp_path / "s0.sqlite"
    assert not MergeRetry(path).pause and not caplog.records
    killed(path)
    assert not MergeRetry(path).pause, "perhaps by a person"
    (line,) = caplog.messages
    assert line.startswith("the process ended before it had merged, as where")
    for times, least in ((2, FIRST), (3, 2 * FIRST)):
        killed(path)
        retry = MergeRetry(path)
        assert least - 5.0 < retry.pause <= least and f"merged {times} times in a row" in retry.words
    with retry.attempt():
        assert (tmp_path / f"s0.sqlite{SUFFIX}").exists()
    retry.succeeded()
    assert not MergeRetry(path).pause, "it merged"
    retry.begin()
    with retry.attempt():
        pass
    assert (tmp_path / f"s0.sqlite{SUFFIX}").exists(), "a part is done, and nothing is merged yet"
    retry.end()
    assert not (tmp_path / f"s0.sqlite{SUFFIX}").exists()
    path.with_name(path.name + SUFFIX).write_text("damaged")
    assert not MergeRetry(path).pause


def test_a_server_that_was_killed_twice_answers_before_it_merges(tmp_path, monkeypatch):
    monkeypatch.setattr(merge_retry, "FIRST", 3.0)
    monkeypatch.setattr("mapweave.mapserver.merge_worker.RETRY", 0.1)
    path = tmp_path / "s0.sqlite"
    for _ in range(2):
        killed(path)
    retry = MergeRetry(path)
    worker = MergeWorker(LiveSchedule(), 1.0, retry=retry)
    worker.start()
    retry.succeeded(whole=False)  # as the server, which merges the constraints before there is a map
    logs = looked_around([R0, R1], 3)
    worker.read(change for which in logs for change in numbered(which, logs[which]))
    assert worker.counters().merges == 0
    assert len(worker.answers.merged.poses) == 8, "each map by itself"
    eventually(lambda: "merging begins again after 3 s" in worker.event)
    assert worker.counters().merges == 0 and not worker.begun
    assert (tmp_path / f"s0.sqlite{SUFFIX}").read_text() == "3"
    eventually(lambda: worker.counters().merges == 1)
    # A merge is counted before it is answered from.
    eventually(lambda: not worker.delay and not (tmp_path / f"s0.sqlite{SUFFIX}").exists())
    assert worker.counters().merges == 1 and len(worker.answers.merged.components) == 1
    worker.close()
    assert not MergeRetry(path).pause


def test_a_server_that_ends_in_order_before_it_has_merged_was_not_killed(tmp_path, caplog):
    path = tmp_path / "s0.sqlite"
    killed(path)
    killed(path)
    worker = MergeWorker(LiveSchedule(), 1.0, retry=MergeRetry(path))
    worker.start()
    logs = looked_around([R0], 3)
    worker.read(change for which in logs for change in numbered(which, logs[which]))
    worker.close()
    caplog.clear()
    assert not MergeRetry(path).pause and not caplog.records


def test_an_intake_that_has_no_memory_ends_the_server_and_loses_nothing(tmp_path):
    """Its thread ended without a word, and the server went on without it."""
    hub = MemoryHub()
    logs = looked_around([R0], 3)
    with (
        closing(Journal(tmp_path / "r0", "r0")) as journal,
        closing(MemoryBus(hub)) as bus,
        pytest.MonkeyPatch.context() as short,
    ):
        robot = Replicator(bus, KEYS, journal, journal.open_map(1), ("s0",), AGENT)
        with MapServer(MemoryBus(hub), KEYS, tmp_path / "s0.sqlite", "s0") as server:
            robot.submit(logs[R0][:3], 1)
            assert robot.wait_acknowledged(60)
            real, few = ReceivedChange.read, [2]

            def read(*arguments: object) -> ReceivedChange:
                few[0] -= 1
                if few[0] < 0:
                    raise MemoryError
                return real(*arguments)  # type: ignore[arg-type]

            short.setattr(ReceivedChange, "read", read)
            robot.submit(logs[R0][3:], 2)
            eventually(lambda: server.broken)
            assert "not enough memory" in server.broken
            assert str(server.status()["event"]) == server.broken
        short.undo()
        with MapServer(MemoryBus(hub), KEYS, tmp_path / "s0.sqlite", "s0") as server:
            assert robot.wait_acknowledged(60)
            assert not server.broken
        robot.close()
        kept = logs_of([journal])
        with closing(SqliteStore(tmp_path / "s0.sqlite")) as store:
            stored = {R0: [(change.sequence, encode_change(change)) for change in store.replay(R0)]}
    assert stored == kept and len(stored[R0]) == len(logs[R0])
