"""Concurrent questions: a long one, and a long merge, block no other."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.nearby import NearbyRequest
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import (
    Certainty,
    KnownRequest,
    Obstacle,
    RelocalizeAnswer,
    RouteAnswer,
    RouteRequest,
)
from mapweave.mapserver import admission_control
from mapweave.mapserver.admission_control import AdmissionSettings
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.mapserver.schedule import LiveSchedule, LockstepSchedule
from mapweave.mapserver.server import MapServer, ServerSettings
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.bus import Reply
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode, encode_view
from mapweave.wire.senders import sent_by
from synthetic.world import take_node

KEYS = Keys("fleet")


@pytest.fixture(autouse=True)
def never_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was accepted is answered, however busy this machine is."""
    monkeypatch.setattr(admission_control, "TOO_LATE", 1e3)


class Served:
    """A map server with a mapped room, and a client."""

    def __init__(self, room, lockstep: bool = False) -> None:
        self.room = room
        hub = MemoryHub()
        self.bus, self.asker = MemoryBus(hub), MemoryBus(hub)
        services = AdmissionSettings(workers=2, in_time=0.31)
        settings, schedule = ServerSettings(services), LockstepSchedule() if lockstep else LiveSchedule()
        self.server = MapServer(self.bus, KEYS, room.path, "s0", settings, schedule)
        self.nodes = sorted(room.truth)

    def __enter__(self) -> Served:
        self.server.__enter__()
        assert self.server.settle(20)
        return self

    def __exit__(self, *_: object) -> None:
        self.server.__exit__(None, None, None)
        self.asker.close()
        self.bus.close()

    def where(self, node: NodeId | None = None, seed: int = 5) -> Reply:
        view = self.room.view(node or self.nodes[2], seed)
        (reply,) = self.asker.ask(KEYS.relocalize("s0"), encode_view(view), 20.0)
        return reply

    def quick_ones(self) -> None:
        """Everything but where a view was taken, with its answer looked at."""
        request = encode(RouteRequest(self.nodes[0], self.nodes[-1]))
        (route,) = self.asker.ask(KEYS.route("s0"), request, 5.0)
        assert decode(route.payload, RouteAnswer).legs
        (known,) = self.asker.ask(KEYS.known("s0"), encode(KnownRequest(self.nodes[0].map, 0, 0, 9)), 5.0)
        assert not known.error
        (status,) = self.asker.ask(KEYS.server_status("s0"), b"", 5.0)
        assert decode_record(status.payload)["nodes"] == len(self.nodes)


@pytest.fixture
def served(mapped_room) -> Iterator[Served]:
    with Served(mapped_room()) as served:
        yield served


class Gate:
    """Holds up calls of a method until it is opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> None:
        self.open = threading.Event()
        self.entered = threading.Semaphore(0)
        real = getattr(owner, name)

        def held(*arguments: object) -> object:
            self.entered.release()
            assert self.open.wait(20)
            return real(*arguments)

        monkeypatch.setattr(owner, name, held)


def test_slow_questions_block_no_other_and_excess_is_refused(served: Served, monkeypatch):
    gate = Gate(monkeypatch, Relocalizer, "answer")
    with ThreadPoolExecutor(12) as askers:
        waiting = [askers.submit(served.where, None, seed) for seed in range(12)]
        for _ in range(2):
            assert gate.entered.acquire(timeout=30)
        served.quick_ones()
        # Two are worked on; four more begin within 0.2 s, if each takes 0.1 s, and end within 0.31 s.
        end = time.monotonic() + 30.0
        while served.server.status()["busy"] != 6 and time.monotonic() < end:
            time.sleep(0.01)
        gate.open.set()
        replies = [future.result(20) for future in waiting]
    refused = [reply for reply in replies if reply.error]
    assert len(refused) == 6
    for reply in refused:
        assert reply.error == f"busy, retry after {reply.retry_after:.1f} s"
        assert 0.0 < reply.retry_after < 1.0
    for reply in replies:
        if not reply.error:
            assert decode(reply.payload, RelocalizeAnswer).certainty is Certainty.FOUND
    assert served.server.status()["answered"] == 6


def test_a_long_merge_holds_up_no_question(served: Served, monkeypatch):
    gate = Gate(monkeypatch, Merger, "merged")
    served.server._worker._dirty = True
    settling = threading.Thread(target=served.server.settle, args=(20.0,))
    settling.start()
    assert gate.entered.acquire(timeout=30)
    assert decode(served.where().payload, RelocalizeAnswer).certainty is Certainty.FOUND
    served.quick_ones()
    assert settling.is_alive()
    gate.open.set()
    settling.join(20)


def test_every_node_is_found_by_many_at_once(served: Served):
    """The same questions one after the other and all at once have the same answers."""
    questions = [(node, seed) for node in served.nodes for seed in (1, 2)]
    alone = [served.where(*question).payload for question in questions]
    with ThreadPoolExecutor(2) as askers:
        together = [reply.payload for reply in askers.map(lambda q: served.where(*q), questions)]
    assert together == alone
    for (node, _), payload in zip(questions, alone, strict=True):
        answer = decode(payload, RelocalizeAnswer)
        assert answer.certainty is Certainty.FOUND
        best = answer.candidates[0]
        true = served.room.truth[best.node].inverse() @ served.room.truth[node]
        # The view is taken 0.11 m beside the node.
        assert true.distance(best.node_from_robot.mean) < 0.25


def test_in_lockstep_questions_are_answered_in_sequence(mapped_room):
    with Served(mapped_room(), lockstep=True) as served, ThreadPoolExecutor(20) as askers:
        replies = [future.result(20) for future in [askers.submit(served.where) for _ in range(20)]]
    assert {reply.error for reply in replies} == {""}
    assert len({reply.payload for reply in replies}) == 1


def test_errors_are_reported_and_cost_no_worker(served: Served, monkeypatch, caplog):
    (reply,) = served.asker.ask(KEYS.relocalize("s0"), b"garbage", 5.0)
    assert reply.error.startswith("view:")
    assert reply.retry_after == 0.0

    def broken(self: Relocalizer, *_: object) -> RelocalizeAnswer:
        raise ZeroDivisionError("a defect")

    with monkeypatch.context() as patch:
        patch.setattr(Relocalizer, "answer", broken)
        for _ in range(5):
            assert served.where().error == "the server failed: a defect"
    assert "no answer to" in caplog.text
    assert not served.where().error


def test_a_merge_that_fails_is_logged_and_the_next_one_succeeds(served: Served, monkeypatch, caplog):
    def broken(self: Merger) -> MergedMap:
        raise ZeroDivisionError("a defect")

    with monkeypatch.context() as patch:
        patch.setattr(Merger, "merged", broken)
        served.server._worker._dirty = True
        assert served.server.settle(20)
    assert "merging failed" in caplog.text
    assert "merging failed" in str(served.server.status()["event"])
    served.quick_ones()
    served.server._worker._dirty = True
    assert served.server.settle(20)
    assert "merging failed" not in str(served.server.status()["event"])
    assert not served.where().error


def test_the_index_is_searched_while_it_grows(mapped_room):
    """Against the same index without concurrent use."""
    room = mapped_room()
    rng = np.random.default_rng(9)
    pose = room.truth[min(room.truth)]
    template = take_node(room.world, NodeId("x", 1, 0), pose, PoseGaussian(Pose2(), np.zeros((3, 3))), rng)
    index = PlaceIndex()
    stop = threading.Event()
    view = room.view(min(room.truth))

    def search() -> None:
        while not stop.is_set():
            assert all(score > 0 for _, score in index.query(view, 5))

    with ThreadPoolExecutor(3) as pool:
        searches = [pool.submit(search) for _ in range(3)]
        for number in range(120):
            index.add(replace(template, id=NodeId("x", 1, number)))
            if number % 3 == 2:
                index.remove(NodeId("x", 1, number - 1))
        stop.set()
        for searche in searches:
            searche.result(20)
    alone = PlaceIndex()
    for number in range(120):
        if number % 3 != 1:
            alone.add(replace(template, id=NodeId("x", 1, number)))
    assert len(index) == 80
    assert {n for n, _ in index.query(view, 80)} == {n for n, _ in alone.query(view, 80)}


def test_a_place_that_one_robot_could_not_pass_is_barred_for_it_and_dear_for_others(mapped_room):
    """A robot stands there by its own word: once it has left, the place is free."""
    with Served(mapped_room(), lockstep=True) as served:
        roads = served.server._answers().router.roads
        start, goal = served.nodes[0], served.nodes[-1]

        def way(robot: str, *obstacles: Obstacle) -> list[NodeId]:
            asked = encode(RouteRequest(start, goal, obstacles=obstacles))
            (reply,) = served.asker.ask(sent_by(KEYS.route("s0"), robot), asked, 20.0)
            assert not reply.error
            return [leg.node.id for leg in decode(reply.payload, RouteAnswer).legs]

        def says(robot: str, node: NodeId, stamp: float) -> None:
            served.server._schedule.observe(round(stamp * 1e9))
            request = NearbyRequest(robot, ((node, Pose2()),), 0.01, 0.01, 0.16, 0.3, 0.3)
            (reply,) = served.asker.ask(sent_by(KEYS.nearby("s0"), robot), encode(request), 20.0)
            assert not reply.error

        free = way("r0")
        middle = free[len(free) // 2]
        thing, other = Obstacle(middle, 0.0, 0.0, 0.1), Obstacle(middle, 0.0, 0.0, 0.1, "r7")
        far = max(served.nodes, key=lambda node: roads.poses[node].distance(roads.poses[middle]))
        assert middle not in way("r0", other)
        assert way("r1") == free, "where robots stand nothing is reported for others"
        says("r7", middle, 0.5)
        says("r0", start, 0.8)
        assert middle not in way("r0", other), "it is there"
        says("r7", far, 1.0)
        says("r0", start, 2.0)
        assert way("r0", other) == free, "it has left"
        way("r0", thing)
        assert served.server._blockages.known(2.0), "others hear of a thing"
