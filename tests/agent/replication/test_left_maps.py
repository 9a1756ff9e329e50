"""Maps that a robot has left are dropped when its server has pruned all of them, and not before."""

import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapweave import HybridMap, MapId, NodeId, Pose2
from mapweave.agent.replication import left_maps
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.left_maps import LeftMaps
from mapweave.agent.replication.replicator import Replicator
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.hybridmap.change import ChangeBody, NodePut
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.merging.pruning import DAY_NS
from mapweave.mapserver.schedule import LiveSchedule
from mapweave.mapserver.server import MapServer
from mapweave.wire.bus import Bus, Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.log_messages import KeptNodes, NewestMap
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.maps import changes_of
from synthetic.world import room, take_map
from tests.mapserver.log.acknowledged_fleet import AGENT, KEYS, SERVER, edge, node
from tests.waiting import eventually, free_port

WAIT = 30.0


def contents(map_id: MapId) -> list[ChangeBody]:
    """Three nodes in a row; of the second there is a newer state."""
    rng = np.random.default_rng(map_id.epoch)
    nodes = [node(map_id, number, rng, 20) for number in (1, 2, 2, 3)]
    return [*nodes, edge(map_id, 4, 1, 2), edge(map_id, 5, 2, 3)]


def nodes_of(map_id: MapId) -> set[NodeId]:
    return {NodeId(*map_id, number) for number in (1, 2, 3)}


class PruningServer:
    """A server's log, without a merge: the test says what is pruned."""

    def __init__(self, bus: Bus, path: Path, pruned: set[NodeId]) -> None:
        self.bus, self.pruned = bus, pruned
        self.store = SqliteStore(path)
        self.ingest = Ingest(
            bus, KEYS, self.store, "s0", lambda change: None, SERVER, pruned=self.pruned.__contains__
        )
        self._alive = bus.announce(KEYS.server_alive("s0"))

    def map_of(self, map_id: MapId) -> HybridMap:
        return HybridMap(change.body for change in self.store.replay(map_id))

    def prune(self, nodes: set[NodeId]) -> None:
        """Those that are in the store."""
        for map_id in {one.map for one in nodes}:
            there = self.map_of(map_id)
            gone = nodes & there.nodes.keys()
            edges = {one.id for name in gone for one in there.edges_at(name)}
            self.store.prune(gone, edges, {})
            self.pruned |= gone

    def close(self) -> None:
        self._alive.close()
        self.ingest.close()
        self.bus.close()
        self.store.close()


class Robot:
    """A robot between two starts of its program; it makes the newest map of its journal."""

    def __init__(self, bus: Bus, path: Path) -> None:
        self.bus, self.journal = bus, Journal(path, "r0")
        self.begin(fresh=not self.journal.maps())

    def begin(self, fresh: bool) -> MapId:
        map_id = self.journal.open_map(None) if fresh else self.journal.maps()[-1]
        self.replicator = Replicator(self.bus, KEYS, self.journal, map_id, ("s0",), AGENT)
        self.left = LeftMaps(self.bus, KEYS, self.journal, self.replicator, "s0")
        return map_id

    def drive(self) -> None:
        """Leave the map for a new one."""
        self.left.close()
        self.replicator.close()
        map_id = self.begin(fresh=True)
        self.replicator.submit(contents(map_id), 1)
        assert self.replicator.flush(WAIT)

    def kept(self, map_id: MapId) -> set[NodeId]:
        return {*HybridMap(RetainedMap.of(self.journal, map_id).contents).nodes}

    def close(self) -> None:
        self.left.close()
        self.replicator.close()
        self.bus.close()
        self.journal.close()


class Fleet:
    """A robot and a server that come and go."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.hub = folder, MemoryHub()
        self.pruned: set[NodeId] = set()
        self.may_go: set[MapId] = set()
        self.server: PruningServer | None = None
        self.robot = Robot(MemoryBus(self.hub), folder / "r0.sqlite")
        self.serve()

    @property
    def left(self) -> list[MapId]:
        return self.robot.journal.maps()[:-1]

    def serve(self) -> PruningServer:
        if self.server is None:
            self.server = PruningServer(MemoryBus(self.hub), self.folder / "s0.sqlite", self.pruned)
        return self.server

    def do(self, what: str, which: int) -> None:
        match what:
            case "drive":
                self.robot.drive()
            case "acknowledged" if self.server is not None:
                assert self.robot.replicator.wait_acknowledged(WAIT)
            case "prune" | "prune some" if self.server is not None:
                maps = self.robot.journal.maps()
                nodes = nodes_of(maps[which % len(maps)])
                self.server.prune(nodes if what == "prune" else {min(nodes)})
                self.may_go |= {one for one in maps if nodes_of(one) <= self.pruned}
            case "look":
                self.robot.left.look()
            case "kill robot":
                self.robot.close()
                self.robot = Robot(MemoryBus(self.hub), self.folder / "r0.sqlite")
            case "kill server" | "lose store":
                if self.server is not None:
                    self.server.close()
                    self.server = None
                if what == "lose store":
                    for part in self.folder.glob("s0.sqlite*"):
                        part.unlink()
                    # Another server of the same name may still be read by threads of the one before.
                    self.pruned = set()
            case "start server":
                self.serve()

    def check(self) -> None:
        """A map is whole, or it was pruned as a whole and is gone as a whole."""
        for map_id in self.robot.journal.maps():
            kept = self.robot.kept(map_id)
            if map_id.epoch > 1:  # the first one is empty
                assert kept == nodes_of(map_id) or (not kept and map_id in self.may_go), map_id

    def close(self) -> None:
        self.robot.close()
        if self.server is not None:
            self.server.close()


DOINGS = (
    "drive", "drive", "acknowledged", "prune", "prune", "prune some", "look", "kill robot", "kill server",
    "lose store", "start server",
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=40)
@given(st.lists(st.tuples(st.sampled_from(DOINGS), st.integers(0, 5)), max_size=14))
@example([("drive", 0), ("drive", 0), ("acknowledged", 0), ("prune", 1), ("look", 0), ("kill robot", 0)])
@example([("drive", 0), ("drive", 0), ("acknowledged", 0), ("prune", 1), ("lose store", 0), ("look", 0)])
@example([("drive", 0), ("drive", 0), ("acknowledged", 0), ("prune some", 1), ("start server", 0)])
def test_in_whatever_order_maps_are_pruned_and_processes_killed(doings: list[tuple[str, int]]):
    """What is not pruned as a whole stays, and a server whose store is gone gets it again."""
    with TemporaryDirectory() as place:
        fleet = Fleet(Path(place))
        for doing in doings:
            fleet.do(*doing)
            fleet.check()
        robot, server = fleet.robot, fleet.serve()
        assert robot.replicator.wait_acknowledged(WAIT)
        robot.left.look()
        for map_id in fleet.left[1:]:
            expected = nodes_of(map_id)
            if expected <= server.pruned and not server.map_of(map_id).nodes:
                eventually(lambda m=map_id: not robot.kept(m))  # type: ignore[misc]
        assert robot.replicator.wait_acknowledged(WAIT)
        fleet.check()
        fleet.do("lose store", 0)
        server = fleet.serve()
        eventually(
            lambda: all(server.store.watermark(m) == robot.journal.head(m) for m in robot.journal.maps())
        )
        for map_id in robot.journal.maps():
            assert {*server.map_of(map_id).nodes} == robot.kept(map_id)
            whole = HybridMap(robot.journal.replay(map_id))
            assert {*server.map_of(map_id).edges} == {*whole.edges}
        fleet.close()


@pytest.fixture
def fleet(tmp_path: Path, opened) -> Fleet:
    return opened(Fleet(tmp_path))


def changes_kept(journal: Journal, map_id: MapId) -> int:
    return len(journal.rows(map_id, 1, journal.head(map_id)))


def test_what_is_pruned_as_a_whole_leaves_the_disk(fleet: Fleet):
    for _ in range(3):
        fleet.robot.drive()
    assert fleet.robot.replicator.wait_acknowledged(WAIT)
    _, old, other, current = fleet.robot.journal.maps()
    server = fleet.serve()
    server.prune(nodes_of(old) | {NodeId(*other, 2)} | nodes_of(current))
    fleet.robot.left.look()
    journal = fleet.robot.journal
    # The newest change and that of the greatest number stay, with what they need.
    eventually(lambda: changes_kept(journal, old) <= 4)
    assert not any(isinstance(body, NodePut) for body in journal.replay(old))
    assert fleet.robot.kept(old) == set()
    assert fleet.robot.kept(other) == nodes_of(other), "a part of it ties the rest"
    assert fleet.robot.kept(current) == nodes_of(current), "the robot drives by it"
    fleet.robot.left.look()
    assert fleet.robot.replicator.wait_acknowledged(WAIT)
    assert not server.map_of(old).nodes


def test_a_map_that_the_server_has_not_acknowledged_is_not_asked_about(fleet: Fleet, opened):
    """Whatever the server would say."""
    fleet.robot.drive()
    assert fleet.robot.replicator.wait_acknowledged(WAIT)
    fleet.do("kill server", 0)
    fleet.robot.drive()
    fleet.robot.drive()
    _, acknowledged, unsent, _ = fleet.robot.journal.maps()
    asked: list[int] = []
    bus = opened(MemoryBus(fleet.hub))

    def answer(request: Request) -> None:
        asked.append(KeptNodes.decode(request.payload).epoch)
        request.reply(NewestMap(3, pruned=True).encode())

    bus.serve(KEYS.all_acks("s0"), answer)
    fleet.robot.left.look()
    assert asked == [acknowledged.epoch]
    eventually(lambda: not fleet.robot.kept(acknowledged))
    # No server has acknowledged the retirements yet.
    fleet.do("kill robot", 0)
    put = {body.node.id for body in fleet.robot.journal.replay(acknowledged) if isinstance(body, NodePut)}
    assert put == nodes_of(acknowledged)
    assert fleet.robot.kept(unsent) == nodes_of(unsent)


@pytest.mark.parametrize("answer", [NewestMap(3).encode(), b"", b"\x81\xa1e\x03", None])
def test_without_a_clear_answer_all_stays(fleet: Fleet, answer: bytes | None, opened):
    """A server that does not know the question, or none."""
    for _ in range(2):
        fleet.robot.drive()
    assert fleet.robot.replicator.wait_acknowledged(WAIT)
    fleet.do("kill server", 0)
    bus = opened(MemoryBus(fleet.hub))
    if answer is None:
        bus.serve(KEYS.all_acks("s0"), lambda request: request.refuse("busy"))
    else:
        bus.serve(KEYS.all_acks("s0"), lambda request: request.reply(answer))
    before = fleet.robot.journal.head(fleet.left[1])
    fleet.robot.left.look()
    assert fleet.robot.replicator.flush(WAIT)
    assert fleet.robot.journal.head(fleet.left[1]) == before
    fleet.check()


def test_a_map_with_a_damaged_change_is_not_asked_about(fleet: Fleet):
    for _ in range(2):
        fleet.robot.drive()
    assert fleet.robot.replicator.wait_acknowledged(WAIT)
    old = fleet.left[1]
    fleet.robot.journal._database.connection.execute(
        "UPDATE change SET body = x'00' WHERE epoch = ? AND sequence = 1", (old.epoch,)
    )
    fleet.serve().prune(nodes_of(old))
    with pytest.raises(InvalidFile, match="change 1"):
        fleet.robot.journal.nodes(old)
    head = fleet.robot.journal.head(old)
    fleet.robot.left.look()
    assert fleet.robot.replicator.flush(WAIT) and fleet.robot.journal.head(old) == head


def test_the_map_that_is_made_and_unknown_ones_are_not_retired(fleet: Fleet):
    replicator = fleet.robot.replicator
    for map_id in (replicator.map_id, MapId("r0", 99)):
        with pytest.raises(InvalidValue, match="was not left"):
            replicator.retire(map_id, nodes_of(map_id), 1)


def test_a_question_without_an_answer_is_asked_again_soon(fleet: Fleet, monkeypatch):
    monkeypatch.setattr(left_maps, "TIMEOUT", 0.2)
    monkeypatch.setattr(left_maps, "RETRY", 0.2)
    for _ in range(2):
        fleet.robot.drive()
    assert fleet.robot.replicator.wait_acknowledged(WAIT)
    fleet.do("kill server", 0)
    bus, asked = MemoryBus(fleet.hub), list[Request]()
    bus.serve(KEYS.all_acks("s0"), asked.append)
    bus.announce(KEYS.server_alive("s0"))
    eventually(lambda: len(asked) == 2)
    asked[1].reply(NewestMap(3, pruned=True).encode())
    bus.close()


def test_it_asks_when_the_server_appears_and_then_at_times(tmp_path, opened):
    hub = MemoryHub()
    robot = opened(Robot(MemoryBus(hub), tmp_path / "r0.sqlite"))
    robot.drive()
    robot.drive()
    server = opened(PruningServer(MemoryBus(hub), tmp_path / "s0.sqlite", set()))
    assert robot.replicator.wait_acknowledged(WAIT)
    robot.left.close()
    robot.left = LeftMaps(robot.bus, KEYS, robot.journal, robot.replicator, "s0", every=0.05)
    old = robot.journal.maps()[1]
    server.prune(nodes_of(old))
    eventually(lambda: not robot.kept(old))


ROBOT = """
import os, signal, sys
from pathlib import Path
from mapweave.agent.replication import left_maps
from mapweave.agent.replication.journal import Journal
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from tests.agent.replication.test_left_maps import Robot
from tests.waiting import eventually

path, endpoint, method, when = sys.argv[1:]
done = getattr(Journal, method)

def killed(journal, map_id, *arguments, **named):
    # Of an acknowledgement the server's name comes first.
    about = arguments[0] if method == "acknowledge" else map_id
    ready = about.epoch == 2 and journal.head(about) > 6
    if method == "write":
        ready = about.epoch == 2
    if ready and when == "before":
        os.kill(os.getpid(), signal.SIGKILL)
    result = done(journal, map_id, *arguments, **named)
    if ready and when == "after":
        os.kill(os.getpid(), signal.SIGKILL)
    return result

left_maps.RETRY = 0.5
if when != "never":
    setattr(Journal, method, killed)
bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
assert bus.wait_connected(20)
robot = Robot(bus, Path(path))
old = robot.journal.maps()[1]
eventually(lambda: not any(type(body).__name__ == "NodePut" for body in robot.journal.replay(old)))
assert robot.replicator.wait_acknowledged(30)
robot.close()
"""


@pytest.mark.slow
@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("method", ["write", "acknowledge", "prune"])
def test_a_robot_is_killed_between_two_steps(tmp_path, method: str, when: str, opened):
    """Before and after it has the retirements on its disk, knows them acknowledged, and drops the nodes."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    path = tmp_path / "r0.sqlite"
    hub = MemoryHub()
    robot = Robot(MemoryBus(hub), path)
    for _ in range(3):
        robot.drive()
    _, old, other, current = robot.journal.maps()
    log = {m: [*robot.journal.replay(m)] for m in (old, other, current)}
    robot.close()
    bus = ZenohBus(BusSettings(mode="router", listen=(endpoint,)))
    server = opened(PruningServer(bus, tmp_path / "s0.sqlite", set()))

    def run(when: str) -> int:
        command = [sys.executable, "-c", ROBOT, str(path), endpoint, method, when]
        return subprocess.run(command, timeout=60, env=dict(os.environ)).returncode

    # It gets what it has to prune from the robot itself.
    client = ZenohBus(BusSettings(endpoints=(endpoint,)))
    robot = Robot(client, path)
    assert robot.replicator.wait_acknowledged(WAIT)
    robot.close()
    server.prune(nodes_of(old) | {NodeId(*other, 1)})
    assert run(when) == -signal.SIGKILL
    journal = Journal(path)
    kept = {m: {*HybridMap(RetainedMap.of(journal, m).contents).nodes} for m in (old, other, current)}
    whole = [body for body in journal.replay(old) if isinstance(body, NodePut)]
    journal.close()
    assert kept[other] == nodes_of(other) and kept[current] == nodes_of(current)
    assert kept[old] == (nodes_of(old) if (method, when) == ("write", "before") else set())
    assert bool(whole) == ((method, when) != ("prune", "after"))
    assert run("never") == 0
    journal = Journal(path)
    assert not any(isinstance(body, NodePut) for body in journal.replay(old))
    for map_id in (other, current):
        assert {*HybridMap(journal.replay(map_id)).edges} == {*HybridMap(log[map_id]).edges}
    journal.close()
    assert not server.map_of(old).nodes and {*server.map_of(current).nodes} == nodes_of(current)
    assert {*server.map_of(other).nodes} == nodes_of(other) - {NodeId(*other, 1)}


class Calendar(LiveSchedule):
    """The machine's clocks, some days later: time has passed."""

    days = 0.0

    def monotonic(self) -> float:
        return super().monotonic() + self.days * 86400.0

    def time_ns(self) -> int:
        return super().time_ns() + round(self.days * DAY_NS)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_journal_of_a_robot_that_leaves_map_after_map_stays_small(tmp_path):
    """A server and a robot's link over TCP: twenty drives through a hall, 3.65 days apart."""
    drives, rng = 20, np.random.default_rng(911)
    hall, clock = room(0, 0, 8, 4, 1600, rng), Calendar()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    sizes: list[int] = []
    sent: dict[MapId, set[NodeId]] = {}
    with ExitStack() as stack:
        bus = ZenohBus(BusSettings(mode="router", listen=(endpoint,)))
        stack.callback(bus.close)
        server = stack.enter_context(MapServer(bus, KEYS, tmp_path / "s0.sqlite", "s0", schedule=clock))
        client = ZenohBus(BusSettings(endpoints=(endpoint,)))
        assert client.wait_connected(20.0)
        robot = Robot(client, tmp_path / "r0.sqlite")
        stack.callback(robot.close)
        for _ in range(drives):
            clock.days += 3.65
            robot.left.close()
            robot.replicator.close()
            map_id = robot.begin(fresh=True)
            y, heading = rng.uniform(1.7, 2.3), rng.uniform(0.2, 0.4)
            tour = [Pose2(1.5 + 0.6 * k, y, heading) for k in range(7)]
            nodes, edges = take_map(hall, map_id, tour, rng, sigma_xy=0.01, sigma_heading=0.01)
            nodes = [replace(one, stamp_ns=clock.time_ns() + one.stamp_ns) for one in nodes]
            sent[map_id] = {one.id for one in nodes}
            robot.replicator.submit(changes_of(nodes, edges), clock.time_ns())
            assert robot.replicator.wait_acknowledged(WAIT) and server.settle(WAIT)
            robot.left.look()
            assert robot.replicator.wait_acknowledged(WAIT)
            sizes.append(sum(len(robot.kept(one)) for one in sent))
            merged = server.merged()
            # Nothing goes that the map still has.
            for one, whole in sent.items():
                kept = robot.kept(one)
                assert kept == whole or not (whole & merged.poses.keys())
    print(sizes)
    assert max(sizes[-5:]) < 0.5 * sum(map(len, sent.values()))
