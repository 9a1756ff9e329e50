"""No map ends the fleet: what a robot may legally send, and what it may not, also over restarts."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import faiss
import msgpack
import numpy as np
import pytest

from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.merge_worker import MergeWorker
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.verification_cache import VerificationCache
from mapweave.mapserver.schedule import LiveSchedule
from mapweave.mapserver.server import MapServer
from mapweave.merge.outlier_rejection import decision_cache
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.bus import Reply, Request
from mapweave.wire.codec import decode_change, encode_body, encode_change, wrap_body
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Ack, Head, LogAnswer, LogRequest, decode_record
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode, encode_view
from synthetic.maps import map_tours, numbered
from synthetic.world import World, room, take_map, take_view
from tests.mapserver.contents import content
from tests.waiting import eventually

KEYS = Keys("fleet")
SOUND = MapId("r0", 1), MapId("r1", 1)
BAD = MapId("bad", 1)
WORLD: World = room(0, 0, 5, 4, 600, np.random.default_rng(1))
TOUR = [Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]


@cache
def views() -> list[View]:
    """Of lost robots."""
    beside = Pose2(0.1, 0.05, 0.05)
    return [take_view(WORLD, TOUR[k] @ beside, np.random.default_rng(k))[0] for k in range(2)]


@cache
def sound_logs() -> dict[MapId, list[bytes]]:
    """Two robots that have mapped one room, as messages."""
    logs = map_tours(WORLD, dict.fromkeys(SOUND, TOUR), np.random.default_rng(2))
    return {map_id: messages(map_id, log) for map_id, log in logs.items()}


def messages(map_id: MapId, changes: list[ChangeBody]) -> list[bytes]:
    return [encode_change(change) for change in numbered(map_id, changes)]


def stored(path: Path, logs: dict[MapId, list[bytes]]) -> Store:
    """A store that has taken them in, as far as it does."""
    store = SqliteStore(path)
    for map_id, log in logs.items():
        entries = [ReceivedChange.read(map_id, k + 1, message) for k, message in enumerate(log)]
        store.apply(map_id, 7, entries, len(entries))
    return store


def node(number: int, landmarks: int = 100) -> Node:
    """Of a place that no other robot has seen, with at most so many landmarks."""
    rng = np.random.default_rng(3)
    (some,), _ = take_map(room(0, 0, 5, 4, 600, rng), BAD, TOUR[:1], rng)
    return replace(some, id=NodeId(*BAD, number), landmarks=some.landmarks.take(np.arange(landmarks)))


def edge(**new: object) -> bytes:
    """An edge between the first two nodes as a message, with fields that no encoder writes."""
    good = Edge(
        NodeId(*BAD, 9), NodeId(*BAD, 1), NodeId(*BAD, 2),
        PoseGaussian.from_sigmas(Pose2(1.0), 0.1, 0.1), EdgeKind.MAPPED,
    )  # fmt: skip
    body: bytes = msgpack.packb({**msgpack.unpackb(encode_body(EdgePut(good))), **new})
    return wrap_body(3, 0, body)


def attacks() -> dict[str, list[bytes]]:
    """Less than a kilobyte each, and taken by servers until they had bounds."""
    bare = [NodePut(node(k, 0)) for k in (1, 2)]
    one = np.array([1e5, 0.0, 1.0])
    rank_one = np.outer(one, one).astype("<f4")[np.triu_indices(3)].tobytes()
    pose = np.array([1.0, 0.0, 0.0], "<f4").tobytes() + rank_one
    seen = [NodePut(node(k)) for k in (1, 2)]
    shared = EdgePut(
        Edge(
            NodeId(*BAD, 9), NodeId(*BAD, 1), NodeId(*BAD, 2),
            PoseGaussian.from_sigmas(Pose2(0.3), 0.1, 0.1), EdgeKind.LOOP, np.repeat([[60, 60]], 9, axis=0),
        )
    )  # fmt: skip
    fewer = NodePut(node(2, 5))
    return {
        "a covariance of rank one": [*messages(BAD, [*bare]), edge(p=pose)],
        "evidence beyond all numbers": [*messages(BAD, [*seen]), edge(w=4, x={"inliers": 9e29})],
        "fewer landmarks than are shared": messages(BAD, [*seen, shared, fewer]),
    }


class Fleet:
    """A server, and a client at the bus that plays all robots and people."""

    def __init__(self, path: Path) -> None:
        hub = MemoryHub()
        self.server_bus, self.bus = MemoryBus(hub), MemoryBus(hub)
        self.acks: list[Ack] = []
        self.server = MapServer(self.server_bus, KEYS, path, "s0").__enter__()
        self.acks_of(BAD.agent)

    def acks_of(self, agent: str) -> None:
        """Hear the acknowledgements for a robot."""
        self.bus.subscribe(KEYS.acks(agent), lambda sample: self.acks.append(Ack.decode(sample.payload)))

    def ask(self, key: str, payload: bytes) -> Reply:
        (reply,) = self.bus.ask(key, payload, 20.0)
        return reply

    def status(self) -> dict[str, object]:
        return dict(decode_record(self.ask(KEYS.server_status("s0"), b"").payload))

    def where(self) -> list[RelocalizeAnswer]:
        """Answers to lost robots."""
        replies = [self.ask(KEYS.relocalize("s0"), encode_view(view)) for view in views()]
        return [decode(reply.payload, RelocalizeAnswer) for reply in replies]

    def tell(self, map_id: MapId, log: list[bytes]) -> None:
        """Have the server pull a log, and wait until it has."""

        def answer(request: Request) -> None:
            asked = LogRequest.decode(request.payload)
            rows = [(k + 1, row) for k, row in enumerate(log) if asked.first <= k + 1 <= asked.last]
            request.reply(LogAnswer(7, asked.first, min(asked.last, len(log)), tuple(rows)).encode())

        served = self.bus.serve(KEYS.log(map_id), answer)
        self.bus.publish(KEYS.head(map_id), Head(7, len(log)).encode())
        eventually(lambda: any(ack.watermark == len(log) for ack in self.acks))
        served.close()

    def close(self) -> None:
        self.server.__exit__(None, None, None)
        self.bus.close()
        self.server_bus.close()


@contextmanager
def serving(path: Path) -> Iterator[Fleet]:
    fleet = Fleet(path)
    try:
        assert fleet.server.settle(30)
        yield fleet
    finally:
        fleet.close()


def whereabouts(answers: list[RelocalizeAnswer]) -> list[tuple[object, ...]]:
    return [
        (answer.certainty, answer.reason, [(c.node, round(c.probability, 9)) for c in answer.candidates])
        for answer in answers
    ]


@pytest.mark.parametrize("name", list(attacks()))
def test_three_changes_of_one_robot_end_nothing(name: str, tmp_path):
    path = tmp_path / "s0.sqlite"
    stored(path, sound_logs()).close()
    with serving(path) as fleet:
        before, places = fleet.status(), whereabouts(fleet.where())
        assert before["links"] and places[0][0] is Certainty.FOUND
        fleet.tell(BAD, attacks()[name])
        eventually(lambda: fleet.status()["nodes"] == int(str(before["nodes"])) + 2)
        assert fleet.server.settle(30)
        during = fleet.status()
        assert during["links"] == before["links"] and not during["set_apart"]
        assert whereabouts(fleet.where()) == places
        refused = [refusal.reason for ack in fleet.acks for refusal in ack.refusals]
        assert bool(refused) is (name != "fewer landmarks than are shared")
    with serving(path) as fleet:
        after = fleet.status()
        assert {k: after[k] for k in ("summary", "event", "set_apart")} == {
            k: during[k] for k in ("summary", "event", "set_apart")
        }
        assert whereabouts(fleet.where()) == places


def fails_with(monkeypatch: pytest.MonkeyPatch, bad: MapId) -> None:
    """Let the merge fail with a map, by an unknown defect."""
    real = decision_cache.fragments_of

    def fails(maps: dict[MapId, HybridMap], *more: Any) -> Any:
        if bad in maps:
            raise ZeroDivisionError("a defect")
        return real(maps, *more)

    monkeypatch.setattr(decision_cache, "fragments_of", fails)


def test_a_map_that_breaks_the_merge_is_set_apart_over_restarts_and_can_be_retired(
    tmp_path, monkeypatch, caplog
):
    path = tmp_path / "s0.sqlite"
    stored(path, sound_logs()).close()
    fails_with(monkeypatch, BAD)
    words = "map bad.1 is set apart: the merge fails with it (ZeroDivisionError: a defect)"
    with serving(path) as fleet:
        places, links = whereabouts(fleet.where()), fleet.status()["links"]
        fleet.tell(BAD, messages(BAD, [NodePut(node(1)), NodePut(node(2))]))
        eventually(lambda: fleet.status()["set_apart"])
        assert fleet.server.settle(30)
        status = fleet.status()
        assert (status["set_apart"], status["links"], status["event"]) == (1, links, words)
        assert whereabouts(fleet.where()) == places
        assert [event.words for event in fleet.server.history()].count(words) == 1
    caplog.clear()
    with serving(path) as fleet:
        status = fleet.status()
        assert (status["set_apart"], status["links"], status["event"]) == (1, links, words)
        assert whereabouts(fleet.where()) == places
        # It was said before.
        assert [event.words for event in fleet.server.history()].count(words) == 1
        retire = ManualConstraint(RetiredMap(BAD), True, "anna", 10**18, "it is mad")
        reply = fleet.ask(KEYS.constrain("s0"), encode(ConstraintRequest(retire)))
        assert not reply.error
        assert fleet.server.settle(30)
        status = fleet.status()
        assert (status["set_apart"], status["links"], status["constraints"]) == (0, links, 1)
        assert status["event"] == "map bad.1 is no longer set apart"
        assert whereabouts(fleet.where()) == places
        never = fleet.ask(
            KEYS.constrain("s0"), encode(ConstraintRequest(replace(retire, about=RetiredMap(MapId("x", 9)))))
        )
        assert "there is no map x.9" in never.error


def test_a_map_can_be_retired_when_nothing_can_be_merged(tmp_path, monkeypatch):
    path = tmp_path / "s0.sqlite"
    stored(path, {BAD: messages(BAD, [NodePut(node(1))])}).close()

    def fails(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    with monkeypatch.context() as patch:
        patch.setattr(Merger, "merged", fails)
        patch.setattr(Merger, "apart", fails)
        with serving(path) as fleet:
            assert not fleet.status()["nodes"]
            reply = fleet.ask(
                KEYS.constrain("s0"),
                encode(ConstraintRequest(ManualConstraint(RetiredMap(BAD), True, "anna", 10**18))),
            )
            assert not reply.error, reply.error
    with serving(path) as fleet:
        assert fleet.status()["constraints"] == 1


class Beside:
    """Two correct robots, merged again with the content of a third one, which is in the store."""

    def __init__(self, folder: Path) -> None:
        self.store = stored(folder / "s0.sqlite", sound_logs())
        self.sound = [(one, change.body) for one in SOUND for change in self.store.replay(one)]
        self.findings = VerificationCache()
        alone, self.merger = self.merged([])
        self.findings = self.merger.findings()
        self.nodes = sorted(alone.poses)
        self.poses = {one: alone.pose(one) for one in self.nodes}
        self.links = [link.pair for link in alone.links]
        self.places = [whereabouts([self.answers.relocalizer.answer(view)]) for view in views()]

    def merged(self, more: list[tuple[MapId, ChangeBody]]) -> tuple[MergedMap, Merger]:
        merger = Merger()
        merger.recollect(self.findings)
        merger.read([*self.sound, *more])

        def use(merged: MergedMap) -> None:
            self.answers = Answers.of(merger, merged, merger.node)

        return merger.merged(use), merger

    def check(self, seed: int) -> None:
        """One content: it raises nothing, is not set apart, and the sound robots are as without it."""
        rng = np.random.default_rng([16, seed])
        # Maps are sorted by name.
        map_id = MapId(str(rng.choice(["a", "r00", "x"])), seed)
        entries = [
            ReceivedChange.read(map_id, k + 1, message)
            for k, message in enumerate(messages(map_id, content(rng, map_id, self.nodes)))
        ]
        self.store.apply(map_id, 7, entries)
        merged, _ = self.merged([(map_id, change.body) for change in self.store.replay(map_id)])
        assert not merged.set_apart, (seed, merged.set_apart)
        between = [p for p in (link.pair for link in merged.links) if map_id not in (p[0].map, p[1].map)]
        assert between == self.links, seed
        for one, pose in self.poses.items():
            assert np.abs(merged.pose(one).vector - pose.vector).max() < 1e-6, (seed, one)
        # Which takes as long as the merge.
        if seed % 4 < len(self.places):
            view = views()[seed % 4]
            assert whereabouts([self.answers.relocalizer.answer(view)]) == self.places[seed % 4], seed


@pytest.fixture
def beside(tmp_path: Path) -> Iterator[Beside]:
    """With a search for like landmarks by one thread: so little is done sooner by one than shared out."""
    threads = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    beside = Beside(tmp_path)
    yield beside
    beside.store.close()
    faiss.omp_set_num_threads(threads)


@pytest.mark.slow
def test_nodes_that_show_the_same_break_nothing(beside: Beside):
    """They are linked with correct maps, and may move these; nothing fails, and no map is left out."""
    seen = [body.node for _, body in beside.sound if isinstance(body, NodePut)]
    linked = 0
    for seed in range(30):
        rng, map_id = np.random.default_rng([17, seed]), MapId("x", seed)
        log: list[tuple[MapId, ChangeBody]] = []
        for body in content(rng, map_id, beside.nodes):
            if isinstance(body, NodePut) and rng.random() < 0.8:
                like = seen[rng.integers(len(seen))]
                some = like.landmarks.take(np.arange(rng.integers(30, len(like.landmarks))))
                # Bit by bit they would be copies.
                some = replace(
                    some, codes=(some.codes ^ rng.integers(0, 2, some.codes.shape)).astype(np.uint8)
                )
                body = NodePut(replace(body.node, landmarks=some, camera=like.camera))
            log.append((map_id, body))
        merged, _ = beside.merged(log)
        linked += any(map_id in (link.a.map, link.b.map) for link in merged.links)
        assert not merged.set_apart, (seed, merged.set_apart)
        assert set(beside.nodes) <= set(merged.poses)
        for view in views():
            beside.answers.relocalizer.answer(view)
    assert linked > 5


def test_a_content_whose_loops_have_singular_covariances_changes_nothing(beside: Beside):
    beside.check(2209)


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "seeds",
    [
        pytest.param(range(60), marks=pytest.mark.slow),
        pytest.param(range(60, 120), marks=pytest.mark.slow),
        pytest.param(range(120, 320), marks=pytest.mark.slow),
        pytest.param(range(320, 3120), marks=pytest.mark.scenario),
    ],
    ids=str,
)
def test_random_legal_contents_change_nothing_for_sound_robots(beside: Beside, seeds: range):
    for seed in seeds:
        beside.check(seed)


@pytest.mark.slow
def test_a_robot_that_never_pauses_holds_up_nobodys_map():
    """It puts one of its nodes 200 times a second."""
    worker = MergeWorker(LiveSchedule(), 1.0)
    worker.start()
    stop = threading.Event()
    logs = {one: [decode_change(message) for message in log] for one, log in sound_logs().items()}

    def hurry() -> None:
        puts = [change for change in logs[SOUND[0]] if isinstance(change.body, NodePut)]
        while not stop.wait(0.005):
            worker.take(puts[0])

    for change in logs[SOUND[0]]:
        worker.take(change)
    hurrying = threading.Thread(target=hurry)
    hurrying.start()
    try:
        time.sleep(0.5)
        for change in logs[SOUND[1]]:
            worker.take(change)
        eventually(lambda: len(worker.answers.merged.links) > 1, 20.0)
        assert len(worker.answers.merged.maps) == 2
    finally:
        stop.set()
        hurrying.join()
        worker.close()
