"""Servers on one PostgreSQL: one merges, the others adopt its merges; any of them may be killed or frozen."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import psycopg
import pytest

from mapweave.hybridmap.change import Change
from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.errors import Busy
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RelocalizeAnswer, View
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.explainer import ConstraintRecord
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.store import MERGE, MERGE_MARK
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.merging import merge_adoption
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.stored_merges import PART
from mapweave.mapserver.server import MapServer, ServerSettings
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ExclusionSettings, MergeSettings
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Mark
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import encode
from synthetic.maps import LOG_ID
from tests.mapserver.merging.test_restart_record import decided, drives
from tests.mapserver.merging.test_stored_merges import numbered
from tests.quick import first_quick
from tests.waiting import eventually

KEYS = Keys("fleet")
PATIENCE = 120.0


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine is no reason to merge."""
    monkeypatch.setattr(merge_adoption, "PATIENCE", 1000.0)
    monkeypatch.setattr(merge_adoption, "FIRST", 1000.0)


def hash_of(merged: MergedMap) -> str:
    return content_hash(map_file_of(merged))


class Servers:
    """Several servers on one bus and one store, and robots that send changes."""

    def __init__(self, address: str, folder: Path) -> None:
        self.address, self.folder = address, folder
        self.hub, self.stack = MemoryHub(), ExitStack()
        self.robot = MemoryBus(self.hub)
        self.running: dict[str, tuple[MapServer, ExitStack]] = {}

    def start(self, *names: str, merging: MergeSettings | None = None) -> None:
        for name in names:
            stack = self.stack.enter_context(ExitStack())
            bus = stack.enter_context(closing(MemoryBus(self.hub)))
            settings = ServerSettings(merge=merging or MergeSettings())
            cache = self.folder / name
            server = stack.enter_context(MapServer(bus, KEYS, self.address, name, settings, cache=cache))
            self.running[name] = server, stack
        eventually(lambda: sum(bool(one.status()["leads"]) for one in self.all) == 1, PATIENCE)

    def end(self, name: str) -> None:
        self.running.pop(name)[1].close()

    @property
    def all(self) -> list[MapServer]:
        return [server for server, _ in self.running.values()]

    def __getitem__(self, name: str) -> MapServer:
        return self.running[name][0]

    @property
    def leader(self) -> MapServer:
        (leader,) = (server for server in self.all if server.status()["leads"])
        return leader

    @property
    def followers(self) -> list[MapServer]:
        return [server for server in self.all if server is not self.leader]

    def send(self, changes: list[Change], pause: float = 0.0) -> None:
        last = {change.map: change.sequence for change in changes}
        store = self.all[0]._store

        def sent() -> bool:
            """What was lost on the way, or beyond a quota, is sent again."""
            for change in changes:
                if change.sequence > store.watermark(change.map):
                    mark = Mark(change.sequence, LOG_ID).encode()
                    self.robot.publish(KEYS.change(change.map), encode_change(change), mark)
                    time.sleep(pause)
            return all(store.watermark(which) >= newest for which, newest in last.items())

        eventually(sent, PATIENCE)

    def settle(self) -> None:
        """Until each server has all that the store has, merged."""
        logs = self.all[0]._store.positions()

        def settled(server: MapServer) -> bool:
            known = {log.map: log.watermark for log in server._ingest._logs.values()}
            there = all(known.get(m, 0) >= position.watermark for m, position in logs.items())
            return there and bool(server.status()["settled"])

        for server in self.all:
            eventually(lambda server=server: settled(server), PATIENCE)


@pytest.fixture
def servers(address: str, tmp_path: Path) -> Iterator[Servers]:
    servers = Servers(address, tmp_path)
    with servers.stack:
        yield servers


def assert_follows(servers: Servers, *, unmerged: bool = True) -> None:
    """The same map on all servers, and answers from it; only the leader has merged."""
    servers.settle()
    leader = servers.leader
    wanted = leader._worker.answers.merged
    name = leader._name
    for server in servers.all:
        merged = server._worker.answers.merged
        assert hash_of(merged) == hash_of(wanted)
        assert decided(merged) == decided(wanted)
        assert merged.poses.keys() == wanted.poses.keys()
        for one, other in zip(merged.graphs, wanted.graphs, strict=True):
            assert (one.means == other.means).all() and one.anchor == other.anchor
        status = server.status()
        assert (status["leader"], status["behind"], status["merges_itself"]) == (name, 0, "")
        if unmerged and server is not leader:
            counters = server._worker.counters()
            assert counters.merges == counters.verified == counters.recognised == 0


def begun(servers: Servers, changes: list[Change]) -> None:
    """Two servers, one of which follows, have these."""
    servers.start("s0", "s1")
    servers.send(changes)
    assert_follows(servers)


def answers_of(server: MapServer, views: list[View]) -> list[RelocalizeAnswer]:
    """To one question after the other; a server that is busy is asked again."""
    answers: list[RelocalizeAnswer] = []
    for number, view in enumerate(views):

        def answered(view: View = view, number: int = number) -> bool:
            with suppress(Busy):
                answers.append(server.locate(lambda: view, number).result(PATIENCE))
            return len(answers) == number + 1

        eventually(answered, PATIENCE)
    return answers


def views_of(changes: list[Change]) -> list[View]:
    """What nodes show, seen once more."""
    nodes = {c.body.node.id: c.body.node for c in changes if hasattr(c.body, "node")}
    return [
        View(node.landmarks.pixels, node.landmarks.codes, node.camera) for _, node in sorted(nodes.items())
    ]


@pytest.mark.parametrize("seed", first_quick(range(1, 5), 1, 2))
def test_followers_have_the_leaders_map_and_give_its_answers(servers: Servers, seed: int):
    changes = numbered(drives(seed))
    servers.start("s0", "s1")
    servers.send(changes[:30], 0.01)
    assert_follows(servers)
    apart = ManualConstraint(Apart((MapId("r0", 1), MapId("r1", 1))), True, "anna", 1, "two kitchens")
    ConstraintRecord(servers.followers[0]._store).add(apart)
    eventually(lambda: all(len(server.constraints().made) == 1 for server in servers.all))
    servers.send(changes[30:], 0.01)
    # One that comes late compares nothing, either.
    servers.start("s2")
    assert_follows(servers)
    views = views_of(changes)[::3]
    wanted = answers_of(servers.leader, views)
    assert sum(bool(answer.candidates) for answer in wanted) > len(views) / 2
    for follower in servers.followers:
        assert [*map(encode, answers_of(follower, views))] == [*map(encode, wanted)]


@pytest.mark.parametrize("seed", first_quick(range(1, 4), 0))
def test_a_follower_takes_over_and_compares_nothing_again(servers: Servers, seed: int):
    changes = numbered(drives(seed))
    servers.start("s0", "s1", "s2")
    servers.send(changes[:40], 0.02)
    assert_follows(servers)
    leader = servers.leader
    before, verified = leader._worker.answers.merged, leader._worker.counters().verified
    servers.end(leader._name)
    eventually(lambda: sum(bool(server.status()["leads"]) for server in servers.all) == 1, PATIENCE)
    eventually(lambda: servers.leader._worker.counters().merges > 0, PATIENCE)
    servers.settle()
    after = servers.leader._worker.answers.merged
    assert decided(after) == decided(before) and hash_of(after) == hash_of(before)
    assert servers.leader._worker.counters().verified == 0 < verified
    servers.send(changes[40:])
    eventually(lambda: servers.followers[0].status()["leader"] == servers.leader._name)
    assert_follows(servers)


DAMAGE: dict[str, Any] = {
    "missing": lambda name, value: None,
    "cut": lambda name, value: value[: len(value) // 2],
    "flipped": lambda name, value: value[:-9] + bytes([value[-9] ^ 1]) + value[-8:],
    "empty": lambda name, value: b"",
}


@pytest.mark.parametrize("name", first_quick([PART.format(0), MERGE, MERGE_MARK], 0))
@pytest.mark.parametrize("how", first_quick(DAMAGE, 1))
def test_a_follower_whose_merge_is_damaged_merges_itself_and_says_so(
    servers: Servers, address: str, name: str, how: str, monkeypatch
):
    changes = numbered(drives(1))
    begun(servers, changes[:24])
    # The leader writes no more: what lies there is all that one that comes late has.
    monkeypatch.setattr(PostgresStore, "publish", lambda store, results: None)
    with psycopg.connect(address, autocommit=True) as people:
        (value,) = people.execute(
            "SELECT value FROM mapweave.result WHERE name = %s", (name,)
        ).fetchone() or (b"",)
        damaged = DAMAGE[how](name, bytes(value))
        if damaged is None:
            people.execute("DELETE FROM mapweave.result WHERE name = %s", (name,))
        else:
            people.execute("UPDATE mapweave.result SET value = %s WHERE name = %s", (damaged, name))
    monkeypatch.setattr(merge_adoption, "PATIENCE", 0.1)
    monkeypatch.setattr(merge_adoption, "FIRST", 0.1)
    servers.start("s2")
    eventually(lambda: servers["s2"].status()["merges_itself"], PATIENCE)
    assert "merge" in str(servers["s2"].status()["merges_itself"])
    servers.settle()
    assert servers["s2"]._worker.counters().merges > 0
    maps = [server._worker.answers.merged for server in servers.all]
    assert all(one.poses.keys() == maps[0].poses.keys() for one in maps)
    # The next good one is followed again.
    monkeypatch.undo()
    monkeypatch.setattr(merge_adoption, "PATIENCE", 1000.0)
    servers.send(changes[24:])
    # So does another one that has seen the damage meanwhile: it looks every few seconds.
    # One that has merged all by itself answers from that merge until it has taken over the leader's.
    eventually(lambda: not any(server.status()["merges_itself"] for server in servers.all), PATIENCE)
    eventually(lambda: len({hash_of(server._worker.answers.merged) for server in servers.all}) == 1, PATIENCE)
    assert_follows(servers, unmerged=False)


def test_a_server_with_other_settings_merges_itself(servers: Servers, monkeypatch):
    monkeypatch.setattr(merge_adoption, "PATIENCE", 0.1)
    servers.start("s0")
    servers.start("s1", merging=MergeSettings(exclusion=ExclusionSettings(doubt=0.01)))
    servers.send(numbered(drives(1))[:24])
    eventually(lambda: "with other settings" in str(servers["s1"].status()["merges_itself"]), PATIENCE)
    servers.settle()
    assert servers["s1"]._worker.counters().merges > 0
    assert len(servers["s1"]._worker.answers.merged.poses) == len(servers["s0"]._worker.answers.merged.poses)


def test_one_server_alone_hands_nothing_over(servers: Servers):
    servers.start("s0")
    servers.send(numbered(drives(1))[:24])
    servers.settle()
    assert servers["s0"]._store.result(MERGE) is None


def failing(merger: Merger, use: object) -> None:
    raise ZeroDivisionError


def test_a_follower_says_that_its_leader_cannot_merge_and_how_old_its_map_is(servers: Servers, monkeypatch):
    changes = numbered(drives(1))
    begun(servers, changes[:24])
    (follower,) = servers.followers
    leader = servers.leader._name
    eventually(lambda: follower.status()["unmerged_s"] == 0.0)
    before = hash_of(follower.merged())
    with monkeypatch.context() as patch:
        patch.setattr(Merger, "_merge", failing)
        began = time.monotonic()
        servers.send(changes[24:30])
        words = f"{leader} leads, and says: merging failed: see the server's log"
        eventually(lambda: str(follower.status()["delay"]).startswith(words), PATIENCE)
        status = follower.status()
        assert status["event"] == status["delay"] and status["behind"]
        since = re.fullmatch(r"; the map lacks what came since (.*) UTC", str(status["delay"])[len(words) :])
        assert since
        oldest = datetime.strptime(f"{since[1]}+0000", "%Y-%m-%d %H:%M%z").timestamp()
        assert time.time() - (time.monotonic() - began) - 61.0 <= oldest <= time.time()
        assert 0.0 < float(status["unmerged_s"]) <= time.monotonic() - began + 0.05  # It is rounded.
        assert float(servers.leader.status()["unmerged_s"]) > 0.0
        # One that comes meanwhile hears it as well.
        servers.start("s2")
        eventually(lambda: servers["s2"].status()["delay"], PATIENCE)
        assert hash_of(follower.merged()) == before and not follower.status()["merges_itself"]
    servers.send(changes[30:])
    assert_follows(servers)
    for server in servers.all:
        eventually(lambda server=server: server.status()["unmerged_s"] == 0.0, PATIENCE)
        assert server.status()["delay"] == ""


def test_a_follower_says_that_its_leader_stands_still(servers: Servers, monkeypatch):
    monkeypatch.setattr(merge_adoption, "SILENT", 3.0)
    changes = numbered(drives(1))
    begun(servers, changes[:24])
    (follower,) = servers.followers
    goes_on = threading.Event()

    def standing(merger: Merger, use: object) -> None:
        goes_on.wait(PATIENCE)
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr(Merger, "_merge", standing)
        servers.send(changes[24:30])
        eventually(lambda: "has not merged" in str(follower.status()["delay"]), PATIENCE)
        goes_on.set()
    servers.send(changes[30:])
    assert_follows(servers)
    assert follower.status()["delay"] == ""


PROCESS = """
import json, sys, threading, time
from pathlib import Path
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub

address, name, folder = sys.argv[1:]
merge, sticks = Merger._merge, threading.Event()

def sticking(merger, use):
    if sticks.is_set():
        print(json.dumps("merging"), flush=True)
        time.sleep(600)
    merge(merger, use)

Merger._merge = sticking
with MapServer(MemoryBus(MemoryHub()), Keys("fleet"), address, name, cache=Path(folder)) as server:
    for line in sys.stdin:
        if line.strip() == "stick":
            sticks.set()
            continue
        # In this order: what is known is merged then, if the status says that all is.
        known = {str(log.map): log.watermark for log in server._ingest._logs.values()}
        status = server.status()
        merged, counters = server._worker.answers.merged, server._worker.counters()
        components = sorted(sorted(map(str, one)) for one in merged.components)
        print(json.dumps({
            **status, "merges": counters.merges, "verified": counters.verified, "known": known,
            "hash": content_hash(map_file_of(merged)), "components": components,
            "poses": {str(node): merged.pose(node).vector.tolist() for node in merged.poses},
        }), flush=True)
"""


class Process:
    """A server in a process of its own, that hears of robots by its store alone."""

    def __init__(self, address: str, name: str, folder: Path) -> None:
        self.name = name
        command = [sys.executable, "-c", PROCESS, address, name, str(folder)]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)

    def tell(self, words: str) -> None:
        assert self.process.stdin is not None
        print(words, file=self.process.stdin, flush=True)

    def says(self) -> Any:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def status(self) -> dict[str, Any]:
        self.tell("status")
        return dict(self.says())

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)


@pytest.fixture
def processes(address: str, tmp_path: Path) -> Iterator[list[Process]]:
    """The first one leads."""
    processes: list[Process] = []
    try:
        for name in ("s0", "s1", "s2"):
            processes.append(Process(address, name, tmp_path / name))
            eventually(lambda: processes[0].status()["leads"], PATIENCE)
        yield processes
    finally:
        for one in processes:
            one.process.kill()
            one.process.communicate()


def put(store: PostgresStore, changes: list[Change]) -> dict[str, int]:
    """What a server does with what it hears; returns how long each log is."""
    for change in changes:
        entry = ReceivedChange.read(change.map, change.sequence, encode_change(change))
        store.apply(change.map, LOG_ID, [entry])
    return {str(which): store.watermark(which) for which in store.maps()}


def settled(one: Process, logs: dict[str, int]) -> dict[str, Any]:
    """What a server says once it has all that the store has."""
    said: dict[str, Any] = {}

    def is_settled() -> bool:
        said.update(one.status())
        return bool(said["settled"]) and said["known"] == logs

    eventually(is_settled, PATIENCE)
    return said


def assert_same_places(said: dict[str, Any], alone: MergedMap) -> None:
    """As far as the order in which changes came allows: links and what is superseded depend on it."""
    assert said["poses"].keys() == {str(node) for node in alone.poses}
    assert said["components"] == sorted(sorted(map(str, one)) for one in alone.components)
    for node in alone.poses:
        x, y, _ = said["poses"][str(node)]
        assert alone.pose(node).distance(Pose2(x, y, 0.0)) < 0.1


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", range(1, 4))
def test_a_leader_killed_while_it_merges_is_replaced(processes: list[Process], address: str, seed: int):
    changes = numbered(drives(seed))
    leader, *others = processes
    with closing(PostgresStore(address, "robots")) as store:
        logs = put(store, changes[:30])
        before = [settled(one, logs) for one in processes]
        assert len({said["hash"] for said in before}) == 1
        assert [said["merges"] for said in before[1:]] == [0, 0] == [said["verified"] for said in before[1:]]
        leader.tell("stick")
        put(store, changes[30:40])
        assert leader.says() == "merging"
        leader.signal(signal.SIGKILL)
        logs = put(store, changes[40:])
        eventually(lambda: any(one.status()["leads"] for one in others), PATIENCE)
        after = [settled(one, logs) for one in others]
        (new,) = (said for said in after if said["leads"])
        (follower,) = (said for said in after if not said["leads"])
        assert (follower["leader"], follower["hash"]) == (new["leader"], new["hash"])
        assert (follower["merges"], follower["verified"], follower["merges_itself"]) == (0, 0, "")
        # Nothing is lost: the store has each change, and the map what another merger makes of them alone.
        stored = [(c.map, c.sequence, encode_change(c)) for m in store.maps() for c in store.replay(m)]
        assert stored == sorted((c.map, c.sequence, encode_change(c)) for c in changes)
        alone = Merger()
        alone.read((change.map, change.body) for change in changes)
        assert_same_places(new, alone.merged())
        assert new["verified"] < alone.counters.verified, "what was compared before is known"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_frozen_leader_is_replaced_and_follows_when_it_continues(processes: list[Process], address: str):
    changes = numbered(drives(2))
    leader, *others = processes
    with closing(PostgresStore(address, "robots")) as store:
        logs = put(store, changes[:30])
        assert len({settled(one, logs)["hash"] for one in processes}) == 1
        leader.signal(signal.SIGSTOP)
        try:
            logs = put(store, changes[30:50])
            eventually(lambda: any(one.status()["leads"] for one in others), PATIENCE)
            for one in others:
                settled(one, logs)
        finally:
            leader.signal(signal.SIGCONT)
        eventually(lambda: not leader.status()["leads"], PATIENCE)
        settled(leader, logs)
        merges = leader.status()["merges"]
        logs = put(store, changes[50:])
        after = [settled(one, logs) for one in processes]
        assert len({said["hash"] for said in after}) == 1
        assert [said["leads"] for said in after].count(True) == 1 and not after[0]["leads"]
        assert not any(said["merges_itself"] for said in after)
        assert after[0]["merges"] == merges
