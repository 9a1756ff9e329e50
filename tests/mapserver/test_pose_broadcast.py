"""Merged poses are published to agents: those that moved noticeably, and all on request."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.replication.merged_poses import MergedPoses
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver import pose_broadcast
from mapweave.mapserver.pose_broadcast import PoseBroadcast
from mapweave.mapserver.server import MapServer
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.wire.bus import Bus, Sample
from mapweave.wire.keys import Keys
from mapweave.wire.pose_messages import PoseNews
from tests.mapserver.house import MappedRoom
from tests.waiting import eventually
from tests.wire.fleets import Fleet, MemoryFleet, ZenohFleet

KEYS = Keys("fleet")
A, B = [NodeId("r0", 1, k) for k in range(1, 6)], [NodeId("r1", 4, k) for k in range(1, 4)]


def graph(nodes: list[NodeId], shift: float = 0.0, turn: float = 0.0) -> PoseGraph:
    """Nodes in a row, all of them shifted, m, and turned, rad."""
    means = np.array([[k + shift, 0.0, turn] for k in range(len(nodes))])
    return PoseGraph(min(nodes), tuple(nodes), means, None)


def merged(*graphs: PoseGraph) -> MergedMap:
    whole = replace(MergedMap.empty(), poses=NodePoses(graphs), graphs=graphs)
    return replace(whole, components=tuple(frozenset(one.nodes) for one in graphs))


@pytest.fixture(autouse=True)
def no_beat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is sent a second time, unless a test says so."""
    monkeypatch.setattr(pose_broadcast, "BEAT", math.inf)


class Received:
    """A pose broadcast, and what it publishes."""

    def __init__(self, fleet: Fleet) -> None:
        self.heard: list[PoseNews] = []
        self.bus, self.agent = fleet.join(), fleet.join()
        self.broadcast = PoseBroadcast(self.bus, KEYS, "s0")
        self.agent.subscribe(KEYS.poses("s0", "r0"), self._hear)
        self._marks = 0
        self._clock = count(0.0, 10.0)

    def _hear(self, sample: Sample) -> None:
        if sample.payload:
            self.heard.append(PoseNews.decode(sample.payload, "r0"))
        else:
            self._marks += 1

    def tell(self, *graphs: PoseGraph) -> list[PoseNews]:
        before = len(self.heard)
        self.broadcast.tell(merged(*graphs), next(self._clock))
        self.wait()
        return self.heard[before:]

    def wait(self) -> None:
        """Until all has come that was published: under one key what is published later comes later."""
        seen = self._marks
        self.bus.publish(KEYS.poses("s0", "r0"), b"")
        eventually(lambda: self._marks > seen)


@pytest.fixture
def memory() -> Iterator[MemoryFleet]:
    fleet = MemoryFleet()
    yield fleet
    fleet.close()


@pytest.fixture
def zenoh() -> Iterator[ZenohFleet]:
    fleet = ZenohFleet()
    yield fleet
    fleet.close()


def test_small_motions_are_not_published_until_they_add_up(memory: MemoryFleet):
    result = Received(memory)
    (first,) = result.tell(graph(A))
    assert set(first.placed) == set(A) and first.after == 0 and first.sequence == 1
    assert result.tell(graph(A, 0.049)) == []
    assert result.tell(graph(A, 0.0, math.radians(0.9))) == []
    # Each step is small; the distance from the published pose counts.
    steps = [result.tell(graph(A, 0.03 * k)) for k in range(1, 5)]
    assert [len(news) for news in steps] == [0, 1, 0, 1]
    (turned,) = result.tell(graph(A, 0.12, math.radians(1.1)))
    assert turned.placed[A[2]].merged_from_node.vector == pytest.approx([2.12, 0, math.radians(1.1)])


def test_a_map_beyond_the_range_of_messages_costs_no_other_its_poses(memory: MemoryFleet):
    """Though its robot comes before the other in the alphabet."""
    result, far = Received(memory), NodeId("a0", 1, 1)
    (news,) = result.tell(graph([far], 2e6), graph(A))
    assert set(news.placed) == set(A)


def test_only_moved_nodes_are_published_to_their_agents(memory: MemoryFleet):
    result = Received(memory)
    result.tell(graph(A), graph(B))
    one = graph(A)
    one.means[3, 1] = 0.2
    (news,) = result.tell(one, graph(B, 5.0))
    assert set(news.placed) == {A[3]}
    # One component now, in the frame of the smallest node of all: same numbers, other frame.
    (news,) = result.tell(graph([*A, *B]))
    assert set(news.placed) == {A[3]}, "the frame of the first is that of both"
    (reply,) = result.agent.ask(KEYS.poses("s0", "r1"), b"", 5.0)
    assert {place.frame for place in PoseNews.decode(reply.payload, "r1").placed.values()} == {A[0]}


def test_removed_nodes_are_published(memory: MemoryFleet):
    result = Received(memory)
    result.tell(graph(A))
    (news,) = result.tell(graph(A[:-1]))
    assert news.gone == (A[-1],) and not news.placed
    (reply,) = result.agent.ask(KEYS.poses("s0", "r0"), b"", 5.0)
    whole = PoseNews.decode(reply.payload, "r0")
    assert set(whole.placed) == set(A[:-1]) and whole.after == 0 and whole.sequence == 2


def test_much_is_published_in_pieces_and_rarely(memory: MemoryFleet, monkeypatch):
    monkeypatch.setattr(pose_broadcast, "MOST", 2)
    result = Received(memory)
    pieces = result.tell(graph(A))
    assert [len(news.placed) for news in pieces] == [2, 2, 1]
    assert [(news.after, news.sequence) for news in pieces] == [(0, 1), (1, 2), (2, 3)]
    broadcast, received = result.broadcast, result.heard
    broadcast.tell(merged(graph(A, 1.0)), 100.0)
    broadcast.tell(merged(graph(A, 2.0)), 101.9)
    result.wait()
    assert len(received) == 6, "two seconds lie between"


def kept(bus: Bus) -> MergedPoses:
    return MergedPoses(bus, KEYS, "r0", "s0")


def at(poses: MergedPoses, node: NodeId, x: float) -> Callable[[], bool]:
    def there() -> bool:
        place = poses.of(node)
        return place is not None and abs(place.merged_from_node.x - x) < 1e-6

    return there


def test_lost_changes_are_pulled_over_zenoh(zenoh: ZenohFleet, monkeypatch):
    """A late agent, lost news, lost last news, a server that starts again, and one that knows less."""
    monkeypatch.setattr(pose_broadcast, "EVERY", 0.0)
    monkeypatch.setattr(pose_broadcast, "BEAT", 0.0)
    server = zenoh.join()
    broadcast = PoseBroadcast(server, KEYS, "s0")
    broadcast.tell(merged(graph(A)))
    alive = server.announce(KEYS.server_alive("s0"))
    poses = kept(zenoh.join())
    eventually(at(poses, A[2], 2.0))
    assert poses.count(A[0].map) == len(A) and poses.of(B[0]) is None
    broadcast.tell(merged(graph(A, 1.0)))
    eventually(at(poses, A[2], 3.0))
    zenoh.cut()
    broadcast.tell(merged(graph(A, 2.0)))
    assert at(poses, A[2], 3.0)()
    zenoh.mend()
    assert server.wait_connected(30)

    def beaten() -> bool:
        broadcast.tell(merged(graph(A, 2.0)))
        return at(poses, A[2], 4.0)()

    eventually(beaten)
    alive.close()
    broadcast.close()
    again = zenoh.join()
    broadcast = PoseBroadcast(again, KEYS, "s0")
    broadcast.tell(merged(graph(A[:3], 7.0)))
    alive = again.announce(KEYS.server_alive("s0"))
    eventually(at(poses, A[2], 9.0))
    assert poses.of(A[4]) is None and poses.count(A[0].map) == 3
    broadcast.tell(merged(graph(A[:2], 7.0)))
    eventually(lambda: poses.of(A[2]) is None)
    poses.close()
    alive.close()
    broadcast.close()


def test_a_map_server_reports_its_merged_map(zenoh: ZenohFleet, mapped_room: Callable[[], MappedRoom]):
    """From the store on the disk to an agent in another session, twice: the server starts again."""
    room = mapped_room()
    poses = kept(zenoh.join())
    for _ in range(2):
        bus = zenoh.join()
        with MapServer(bus, KEYS, Path(room.path), "s0") as server:
            assert server.settle(30)
            eventually(lambda: all(poses.of(node) for node in room.truth))
            first = min(room.truth)
            for node in room.truth:
                place = poses.of(node)
                assert place is not None and place.frame == first
                off = place.merged_from_node.inverse() @ (room.truth[first].inverse() @ room.truth[node])
                assert off.distance(Pose2()) < 0.3
        bus.close()
    poses.close()
