"""Servers that share a store: one prunes, all have the same map, and nothing is lost when one is killed."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace

import pytest

from mapweave.agent.replication.merged_poses import MergedPoses
from mapweave.hybridmap.change import Change, EdgePut, NodePut
from mapweave.hybridmap.ids import NodeId
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.store import PRUNING, PRUNING_MARK, News, Store
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.merge_worker import MergeWorker
from mapweave.mapserver.merging import merge_adoption, pruning
from mapweave.mapserver.merging.pruning_record import PruningRecord
from mapweave.mapserver.schedule import LiveSchedule
from mapweave.mapserver.server import MapServer
from mapweave.merge.pose_graph.marginalization import is_marginal
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.opened_map import open_map
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.mapserver.merging.test_pruning import BEGIN, DAYS, MAPS, Logs, Server, poses_apart, serving
from tests.waiting import eventually

KEYS = Keys("fleet")
PATIENCE = 120.0


@pytest.fixture(scope="module")
def logs() -> Logs:
    return Logs()


@pytest.fixture
def stores(address: str) -> Iterator[Callable[[str], Store]]:
    """Makes sessions of servers, which end with the test."""
    with ExitStack() as stack:
        yield lambda name: stack.enter_context(closing(PostgresStore(address, name)))


class Front(Server):
    """One of several servers: it goes on where others have brought the logs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.known = {m: self.store.watermark(m) for m in self.store.maps()}

    def catch_up(self) -> None:
        for map_id in self.store.maps():
            for change in self.store.replay(map_id, self.known.get(map_id, 0)):
                self.merger.on_change(change)
                self.known[map_id] = change.sequence

    def lead(self) -> None:
        self.store.follow(lambda news: None)
        eventually(lambda: self.store.leads)


def send(store: Store, changes: list[Change]) -> None:
    map_id = changes[0].map
    store.apply(map_id, 5, [ReceivedChange.read(map_id, one.sequence, encode_change(one)) for one in changes])


def ends(put: EdgePut) -> tuple[NodeId, NodeId]:
    return put.edge.a, put.edge.b


def marginals(merged: MergedMap) -> set[tuple[NodeId, NodeId]]:
    return {link.pair for link in merged.links if is_marginal(link)}


def assert_same(one: MergedMap, other: MergedMap) -> None:
    assert set(one.poses) == set(other.poses) and one.pruned == other.pruned
    assert marginals(one) == marginals(other) and poses_apart(one, other) < 1e-3
    assert len(one.components) == len(other.components) == 1


@pytest.fixture
def servers(logs: Logs, stores: Callable[[str], Store]) -> list[Front]:
    """Two that have everything; the first one leads, and has begun to count the days."""
    both = [Front(stores(name)) for name in ("s0", "s1")]
    for map_id in MAPS:
        send(both[0].store, logs.changes[map_id])
    for server in both:
        server.catch_up()
    both[0].lead()
    assert not both[0].prune(0.0)
    return both


def test_what_the_leader_prunes_the_others_let_go(
    servers: list[Front], stores: Callable[[str], Store], address: str
):
    leader, other = servers
    news: list[News] = []
    other.store.follow(news.append)
    before = other.merged()
    state = leader.store.result(PRUNING)
    other.record.adopt(other.merger)
    assert not other.prune(DAYS + 1.0) and other.store.result(PRUNING) == state, "it does not lead"
    assert leader.prune(DAYS + 1.0) and not leader.record.outdated
    eventually(lambda: any(one.records and PRUNING_MARK in one.records for one in news))
    assert other.record.outdated
    other.record.adopt(other.merger)
    merged = leader.merged()
    gone = set(before.poses) - set(merged.poses)
    assert gone == set(merged.pruned.nodes) and len(gone) >= 4 and marginals(merged)
    assert_same(merged, other.merged())
    assert not any(node in other.merger.places for node in gone) and not other.record.outdated
    # Who starts later, and who opens the store, has the same map.
    assert_same(merged, Front(stores("s2")).merged())
    opened = open_map(address).merged()
    assert set(opened.poses) == set(merged.poses) and poses_apart(merged, opened) < 2e-3
    assert marginals(opened) == marginals(merged)


def test_a_leader_of_before_writes_over_nothing(servers: list[Front], monkeypatch):
    """One that stood still believes that it leads."""
    monkeypatch.setattr(PostgresStore, "leads", True)
    old, new = servers
    assert not old.prune(DAYS - 1.0), "it looks each day, and stands still from now on"
    assert not new.prune(DAYS + 1.0), "it has not read yet since when nodes are superseded"
    new.record.adopt(new.merger)
    assert new.prune(DAYS + 2.0), "the days go on from those of the record"
    record = {name: new.store.result(name) for name in (PRUNING, PRUNING_MARK, "pruned 0")}
    assert not old.prune(DAYS + 3.0)
    assert record == {name: old.store.result(name) for name in record}
    old.record.adopt(old.merger)
    assert_same(new.merged(), old.merged())
    assert not old.prune(DAYS + 4.0), "nothing is pruned twice"
    new.record.adopt(new.merger)
    assert_same(new.merged(), old.merged())
    assert {left.stamp_ns for left in old.merged().pruned.nodes.values()} == {
        left.stamp_ns for left in new.merged().pruned.nodes.values()
    }


def test_what_a_robot_sends_while_it_is_pruned_is_kept_by_all(
    servers: list[Front], logs: Logs, stores: Callable[[str], Store]
):
    leader, other = servers
    node = min(set(other.merged().superseded) - {leader.merged().graphs[0].nodes[0]})
    log = logs.changes[node.map]
    put = next(one.body for one in log if isinstance(one.body, NodePut) and one.body.node.id == node)
    again = NodePut(replace(put.node, stamp_ns=put.node.stamp_ns + 7))
    edge = next(one.body for one in log if isinstance(one.body, EdgePut) and node in ends(one.body))
    fresh = [Change(node.map, len(log) + k, BEGIN, body) for k, body in enumerate((again, edge), 1)]
    # The other one has taken it, and the leader has not heard of it.
    send(other.store, fresh)
    other.catch_up()
    last = dict(leader.known)
    assert leader.record.prune(leader.merger, BEGIN + round((DAYS + 1.0) * pruning.DAY_NS), last)
    assert node in leader.merger.pruning.pruned
    leader.catch_up()
    other.record.adopt(other.merger)
    late = Front(stores("s2"))
    for server in (leader, other, late):
        kept = server.merger.node(node)
        assert kept is not None and kept.stamp_ns == again.node.stamp_ns
        assert [one.id for one in server.merger.maps[node.map].edges_at(node)] == [edge.edge.id]
        assert_same(leader.merged(), server.merged())


def test_what_postgresql_has_lost_again_returns(servers: list[Front], logs: Logs, monkeypatch):
    """Commits that no standby confirmed, seen before the primary was lost."""
    leader, other = servers
    names = (PRUNING, PRUNING_MARK)
    record = {name: leader.store.result(name) for name in names}
    before = other.merged()
    assert leader.prune(DAYS + 1.0)
    other.record.adopt(other.merger)
    gone = set(before.poses) - set(other.merged().poses)
    put = [
        entry
        for map_id in MAPS
        for entry in logs.changes[map_id]
        if (isinstance(entry.body, NodePut) and entry.body.node.id in gone)
        or (isinstance(entry.body, EdgePut) and not gone.isdisjoint(ends(entry.body)))
    ]
    for change in put:
        list(leader.store.restore(change.map, change.sequence, change.sequence, [
            ReceivedChange.read(change.map, change.sequence, encode_change(change))
        ]))  # fmt: skip
    for name, value in record.items():
        assert value is not None
        leader.store.put_result(name, value)
    for server in servers:
        assert server.record.outdated
        server.record.adopt(server.merger)
        merged = server.merged()
        assert set(merged.poses) == set(before.poses) and not merged.pruned.nodes and not marginals(merged)
        # They are compared once more, not with each of the others as before.
        assert len(merged.components) == 1 and poses_apart(before, merged) < 0.05


def test_a_record_that_is_written_while_it_is_read_is_read_again(servers: list[Front], monkeypatch):
    leader, other = servers
    merged, result = other.merged(), type(other.store).result
    pruned: list[bool] = []

    def meanwhile(store: Store, name: str) -> bytes | None:
        value = result(store, name)
        if store is other.store and name == PRUNING and not pruned:
            pruned.append(leader.prune(DAYS + 1.0))
        return value

    with monkeypatch.context() as patch:
        patch.setattr(type(other.store), "result", meanwhile)
        other.record.adopt(other.merger)
    assert pruned == [True] and set(other.merged().poses) < set(merged.poses)
    assert_same(leader.merged(), other.merged())


def test_a_change_that_waited_while_its_node_was_pruned_brings_nothing_back(logs: Logs, tmp_path):
    with serving(tmp_path / "s0.sqlite") as server:
        for map_id in MAPS:
            server.take(logs.changes[map_id])
        server.prune(0.0)
        assert server.prune(DAYS + 1.0)
        gone, fresh = sorted(server.merged().pruned.nodes)[:2]
        puts = {
            one.body.node.id: one
            for map_id in MAPS
            for one in logs.changes[map_id]
            if isinstance(one.body, NodePut)
        }
        last = len(logs.changes[fresh.map])
        again = Change(fresh.map, last + 1, BEGIN, puts[fresh].body)
        send(server.store, [again])
        worker = MergeWorker(LiveSchedule(), 1.0, pruning=PruningRecord(server.store, DAYS, tuple, ()))
        worker.start()
        worker.read(change for map_id in MAPS for change in server.store.replay(map_id))
        for change in (puts[gone], again):
            worker.take(change)
        assert worker.settle(PATIENCE)
        merged = worker.answers.merged
        worker.close()
    assert fresh in merged.poses, "it was sent again"
    assert gone not in merged.poses and gone in merged.pruned


def hash_of(server: MapServer) -> str:
    return content_hash(map_file_of(server.merged()))


def test_a_server_that_follows_has_the_pruned_map_and_the_merges_after_it(
    logs: Logs, address: str, tmp_path, monkeypatch
):
    """Just the leader's, without a merge of its own."""
    for patience in ("PATIENCE", "FIRST"):
        monkeypatch.setattr(merge_adoption, patience, 1000.0)
    hub = MemoryHub()
    with ExitStack() as stack:

        def start(name: str) -> MapServer:
            bus = stack.enter_context(closing(MemoryBus(hub)))
            return stack.enter_context(MapServer(bus, KEYS, address, name, cache=tmp_path / name))

        leader = start("s0")
        eventually(lambda: leader.status()["leads"])
        follower = start("s1")

        def same() -> bool:
            settled = leader.settle(PATIENCE) and follower.settle(PATIENCE)
            return settled and hash_of(follower) == hash_of(leader)

        feeder = stack.enter_context(closing(PostgresStore(address, "feeder")))
        for map_id in MAPS:
            send(feeder, logs.changes[map_id])
        nodes = {c.body.node.id for log in logs.changes.values() for c in log if isinstance(c.body, NodePut)}
        eventually(lambda: {*leader.merged().poses} == nodes and same())
        assert follower.merged().superseded and not follower.merged().pruned.nodes

        with monkeypatch.context() as patch:
            patch.setattr(pruning, "DAY_NS", 1)

            def pruned() -> bool:
                leader._constrain()
                return leader.settle(PATIENCE) and bool(leader.merged().pruned.nodes)

            eventually(pruned)
            eventually(same)
        merged, gone = follower.merged(), {*leader.merged().pruned.nodes}
        assert gone == {*merged.pruned.nodes} == nodes - {*merged.poses}
        assert not any(node in follower._worker._merger.places for node in gone)
        assert marginals(merged) == marginals(leader.merged())

        # The next merge has what comes, and not what has left.
        node = max(merged.poses)
        again = replace(merged.maps[node.map].nodes[node], stamp_ns=BEGIN + 7)
        send(feeder, [Change(node.map, len(logs.changes[node.map]) + 1, BEGIN, NodePut(again))])
        eventually(lambda: leader.merged().maps[node.map].nodes[node].stamp_ns == BEGIN + 7 and same())
        merged, counters = follower.merged(), follower._worker.counters()
        assert merged.maps[node.map].nodes[node].stamp_ns == BEGIN + 7 and gone.isdisjoint(merged.poses)
        assert (counters.merges, counters.verified, follower.status()["merges_itself"]) == (0, 0, "")


CHILD = """
import sys, time
from pathlib import Path
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.merging import pruning
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub

put = PostgresStore._put

def stop(store, table, values):
    put(store, table, values)
    if values[0] == "pruned 0":
        print("in the midst", flush=True)
        time.sleep(600)

pruning.DAY_NS = 1
PostgresStore._put = stop
address, folder = sys.argv[1:]
with MapServer(MemoryBus(MemoryHub()), Keys("fleet"), address, "s0", cache=Path(folder)) as server:
    while True:
        server._constrain()
        server.settle(60)
"""


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_leader_that_is_killed_while_it_prunes(logs: Logs, address: str, tmp_path, monkeypatch):
    """Another one does it, once; a third follows; robots of both hear which nodes they may retire."""
    monkeypatch.setattr(pruning, "DAY_NS", 1)
    hub = MemoryHub()

    def server(name: str) -> MapServer:
        return MapServer(MemoryBus(hub), KEYS, address, name, cache=tmp_path / name)

    with ExitStack() as stack:
        feeder = stack.enter_context(closing(PostgresStore(address, "feeder")))
        for map_id in MAPS:
            send(feeder, logs.changes[map_id])
        command = [sys.executable, "-c", CHILD, address, str(tmp_path / "s0")]
        child = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        stack.callback(child.kill)
        assert child.stdout is not None and child.stdout.readline() == "in the midst\n"
        with monkeypatch.context() as patch:
            patch.setattr(merge_adoption, "FIRST", 1.0)  # this leader will never have merged
            one = stack.enter_context(server("s1"))
            assert one.settle(PATIENCE) and not one.status()["leads"]
        poses = [MergedPoses(MemoryBus(hub), KEYS, "r0", name) for name in ("s1", "s2")]
        for listening in poses:
            stack.callback(listening.close)
        before = one.merged()
        child.send_signal(signal.SIGKILL)
        child.wait()
        assert feeder.result("pruned 0") is None
        assert all(feeder.landmarks(node) is not None for node in before.poses), "half is nothing"

        both = [one, stack.enter_context(server("s2"))]
        eventually(lambda: sum(bool(running.status()["leads"]) for running in both) == 1, PATIENCE)
        leader, other = sorted(both, key=lambda running: not running.status()["leads"])
        superseded = {node for node in before.superseded if node.agent == "r0"}
        for listening in poses:
            eventually(lambda heard=listening: any(heard.of(node) for node in superseded), PATIENCE)

        def pruned() -> bool:
            leader._constrain()
            return leader.settle(PATIENCE) and bool(leader.merged().pruned.nodes)

        eventually(pruned, PATIENCE)
        eventually(lambda: other.merged().pruned == leader.merged().pruned, PATIENCE)
        assert leader.settle(PATIENCE) and other.settle(PATIENCE)
        gone = set(before.poses) - set(leader.merged().poses)
        assert gone and gone == set(leader.merged().pruned.nodes)
        assert all(feeder.landmarks(node) is None for node in gone)
        own = sorted(node for node in gone if node.agent == "r0")
        left = {node for node in leader.merged().poses if node.agent == "r0"}
        for listening in poses:
            eventually(lambda heard=listening: all(heard.of(node) is None for node in own), PATIENCE)
            eventually(lambda heard=listening: all(heard.of(node) is not None for node in left), PATIENCE)
        again = stack.enter_context(server("s0"))
        assert again.settle(PATIENCE)
        for running in (other, again):
            assert_same(leader.merged(), running.merged())
