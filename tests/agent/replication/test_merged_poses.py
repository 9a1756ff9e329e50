"""A server that floods a robot with poses of its nodes, or names nodes without end."""

import logging
import threading
from collections.abc import Iterator

import pytest

from mapweave import MapId, NodeId, Pose2
from mapweave.agent.replication import merged_poses
from mapweave.agent.replication.merged_poses import MergedPoses
from mapweave.wire.bus import Request
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.pose_messages import MergedPose, PoseNews
from tests.waiting import eventually

KEYS = Keys("fleet")
MAP = MapId("r0", 1)


class LyingServer:
    """Sends what the test says, and answers questions with no poses once it may."""

    def __init__(self, hub: MemoryHub) -> None:
        self.bus, self.asked, self.may_answer = MemoryBus(hub), 0, threading.Event()
        self.may_answer.set()
        self.bus.serve(KEYS.poses("s0", "r0"), self._answer)

    def send(self, payload: bytes) -> None:
        self.bus.publish(KEYS.poses("s0", "r0"), payload)

    def _answer(self, request: Request) -> None:
        self.asked += 1
        self.may_answer.wait(10.0)
        request.reply(PoseNews(7, 0, 1).encode("r0"))


@pytest.fixture
def server(hub: MemoryHub) -> Iterator[LyingServer]:
    server = LyingServer(hub)
    yield server
    server.may_answer.set()
    server.bus.close()


@pytest.fixture
def poses(hub: MemoryHub) -> Iterator[MergedPoses]:
    bus = MemoryBus(hub)
    poses = MergedPoses(bus, KEYS, "r0", "s0")
    yield poses
    poses.close()
    bus.close()


def news(after: int, first: int, count: int) -> bytes:
    place = MergedPose(NodeId(*MAP, 1), Pose2())
    placed = {NodeId(*MAP, number): place for number in range(first, first + count)}
    return PoseNews(7, after, after + 1, placed).encode("r0")


def test_a_flood_fills_neither_memory_nor_log(server: LyingServer, poses: MergedPoses, caplog):
    """Each message may have 8 MB, and a question to a server that says nothing takes 3 s."""
    server.may_answer.clear()
    with caplog.at_level(logging.WARNING):
        for k in range(1000):
            server.send(bytes([k % 256, k // 256]))
        assert poses._work.qsize() <= merged_poses.MOST_WAITING
        server.may_answer.set()
        eventually(lambda: poses._work.qsize() == 0)
    assert len(caplog.records) == 1
    # What is right is taken afterwards as before.
    server.send(news(1, 1, 3))
    eventually(lambda: poses.count(MAP) == 3)


def test_no_more_poses_are_kept_than_one_message_holds(server: LyingServer, poses: MergedPoses, monkeypatch):
    monkeypatch.setattr(merged_poses, "MAX_POSTURES", 10)
    server.send(news(1, 1, 6))
    eventually(lambda: server.asked == 1)
    server.send(news(1, 1, 6))
    eventually(lambda: poses.count(MAP) == 6)
    server.send(news(2, 5, 6))
    eventually(lambda: poses.count(MAP) == 10)
    server.send(news(3, 11, 6))
    # All are asked for again.
    eventually(lambda: server.asked == 2 and poses.count(MAP) == 0)
