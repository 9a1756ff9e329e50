"""The ingest against agents that are played by hand, so that each mishap can be made to happen."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hybridmap.change import Change, NodeRetired
from hybridmap.errors import InvalidFile
from hybridmap.node import MapId, NodeId
from mapserver.agent_log import AgentLog, PullSettings
from mapserver.entry import Applied, Entry
from mapserver.ingest import Ingest, IngestSettings
from mapserver.store import Store
from wire.bus import Request, Sample
from wire.codec import MAX_CHANGE_BYTES, encode_change
from wire.keys import Keys
from wire.log_messages import Ack, Head, LogAnswer, LogRequest, Mark, Refusal
from wire.memory import MemoryBus, MemoryHub

KEYS = Keys("fleet")
MAP = MapId("r0", 3)
LOG_ID = 77
QUICK = IngestSettings(PullSettings(grace=0.1, first_pause=0.02, longest_pause=0.1), retry_interval=0.05)


def eventually(condition: Callable[[], object], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.003)


def message(sequence: int, map_id: MapId = MAP) -> bytes:
    return encode_change(Change(map_id, sequence, sequence, NodeRetired(NodeId(*map_id, sequence))))


class HandAgent:
    """Does exactly what the test says."""

    def __init__(self, hub: MemoryHub, map_id: MapId = MAP, log_id: int = LOG_ID) -> None:
        self.bus = MemoryBus(hub)
        self.map, self.log_id = map_id, log_id
        self.acks: list[Ack] = []
        self.asked: list[LogRequest] = []
        self.log: dict[int, bytes] = {}
        self.bus.subscribe(
            KEYS.acks(map_id.agent), lambda sample: self.acks.append(Ack.decode(sample.payload))
        )

    def publish(self, sequence: int, data: bytes | None = None) -> None:
        mark = Mark(sequence, self.log_id).encode()
        data = message(sequence, self.map) if data is None else data
        self.bus.publish(KEYS.change(self.map), data, mark)

    def beacon(self, newest: int, **acknowledged: int) -> None:
        self.bus.publish(KEYS.head(self.map), Head(self.log_id, newest, acknowledged).encode())

    def serve(
        self, newest: int, answer: Callable[[LogRequest], LogAnswer | bytes | str] | None = None
    ) -> None:
        """Answer for the log 1 .. newest, or as told; text refuses."""
        self.log = {sequence: message(sequence, self.map) for sequence in range(1, newest + 1)}

        def handle(request: Request) -> None:
            asked = LogRequest.decode(request.payload)
            self.asked.append(asked)
            given = answer(asked) if answer else self.answer(asked)
            if isinstance(given, str):
                request.refuse(given)
            else:
                request.reply(given if isinstance(given, bytes) else given.encode())

        self.bus.serve(KEYS.log(self.map), handle)

    def answer(self, asked: LogRequest) -> LogAnswer:
        rows = tuple((s, data) for s, data in self.log.items() if asked.first <= s <= asked.last)
        return LogAnswer(self.log_id, asked.first, min(asked.last, max(self.log)), rows)


class Server:
    """An ingest with its store, which can be restarted."""

    def __init__(self, hub: MemoryHub, path: Path, name: str = "s0") -> None:
        self.hub, self.path, self.name = hub, path, name
        self.seen: list[Change] = []
        self.on_change: Callable[[Change], None] = self.seen.append
        self.begin()

    def begin(self) -> None:
        self.bus = MemoryBus(self.hub)
        self.store = Store(self.path)
        self.ingest = Ingest(self.bus, KEYS, self.store, self.name, lambda c: self.on_change(c), QUICK)

    def end(self) -> None:
        self.ingest.close()
        self.bus.close()
        self.store.close()

    @property
    def sequences(self) -> list[int]:
        return [change.sequence for change in self.seen]


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


@pytest.fixture
def server(hub: MemoryHub, tmp_path: Path) -> Iterator[Server]:
    server = Server(hub, tmp_path / "s0.sqlite")
    yield server
    server.end()


@pytest.fixture
def agent(hub: MemoryHub) -> Iterator[HandAgent]:
    agent = HandAgent(hub)
    yield agent
    agent.bus.close()


def test_changes_are_applied_and_acknowledged(server: Server, agent: HandAgent) -> None:
    for sequence in (1, 2, 3):
        agent.publish(sequence)
    eventually(lambda: agent.acks and agent.acks[-1] == Ack(MAP, LOG_ID, 3))
    eventually(lambda: server.sequences == [1, 2, 3])
    assert server.store.watermark(MAP) == 3


def test_a_change_is_on_the_disk_before_anybody_hears_of_it(server: Server, agent: HandAgent) -> None:
    stored: list[int] = []
    server.on_change = lambda change: stored.append(server.store.watermark(MAP) - change.sequence)
    agent.publish(1)
    eventually(lambda: stored)
    assert stored == [0]


def test_a_reordered_change_waits_for_its_turn_without_being_pulled(server: Server, agent: HandAgent) -> None:
    for sequence in (1, 3, 2, 4):
        agent.publish(sequence)
    eventually(lambda: server.sequences == [1, 2, 3, 4])
    assert server.ingest.counters().pulls == 0


def test_doubles_are_counted_and_dropped(server: Server, agent: HandAgent) -> None:
    for sequence in (1, 1, 2, 1, 2, 2):
        agent.publish(sequence)
    eventually(lambda: server.ingest.counters().messages == 6)
    eventually(lambda: server.sequences == [1, 2])
    assert server.ingest.counters().doubled == 4


def test_a_gap_is_pulled_and_only_the_gap(server: Server, agent: HandAgent) -> None:
    agent.serve(9)
    agent.publish(1)
    for sequence in (5, 6):
        agent.publish(sequence)
    eventually(lambda: server.sequences == [1, 2, 3, 4, 5, 6])
    assert agent.asked == [LogRequest(2, 4)]


def test_a_beacon_alone_brings_everything_in_chunks(server: Server, agent: HandAgent) -> None:
    agent.serve(600)
    agent.beacon(600)
    eventually(lambda: server.sequences == list(range(1, 601)))
    assert agent.asked == [LogRequest(1, 256), LogRequest(257, 512), LogRequest(513, 600)]
    eventually(lambda: agent.acks[-1].watermark == 600)


def test_a_shorter_answer_than_asked_for_goes_on_where_it_ends(server: Server, agent: HandAgent) -> None:
    agent.serve(10, lambda asked: agent.answer(LogRequest(asked.first, min(asked.last, asked.first + 2))))
    agent.beacon(10)
    eventually(lambda: server.sequences == list(range(1, 11)))
    assert [asked.first for asked in agent.asked] == [1, 4, 7, 10]


def test_changes_that_the_agent_has_pruned_leave_holes(server: Server, agent: HandAgent) -> None:
    agent.serve(8)
    for pruned in (1, 4, 5):
        del agent.log[pruned]
    agent.beacon(8)
    eventually(lambda: server.sequences == [2, 3, 6, 7, 8])
    assert server.store.watermark(MAP) == 8


def test_a_beacon_that_knows_less_is_told_again(server: Server, agent: HandAgent) -> None:
    agent.publish(1)
    eventually(lambda: len(agent.acks) == 1)
    agent.beacon(1, s0=1)
    agent.beacon(1, s0=0)
    eventually(lambda: len(agent.acks) == 2)
    agent.beacon(1)
    eventually(lambda: len(agent.acks) == 3)
    assert {ack.watermark for ack in agent.acks} == {1}


def test_a_change_damaged_on_the_way_is_pulled(server: Server, agent: HandAgent) -> None:
    agent.serve(2)
    agent.publish(1, b"\xc1" * 50)
    agent.publish(2)
    eventually(lambda: server.sequences == [1, 2])
    assert server.ingest.counters().damaged == 1
    assert server.store.refused() == 0


def test_a_change_bad_in_the_log_is_refused_once_and_the_log_goes_on(
    server: Server, agent: HandAgent
) -> None:
    agent.serve(4)
    agent.log[2] = b"\xc1" * 50
    agent.log[3] = message(99)
    agent.beacon(4)
    eventually(lambda: server.sequences == [1, 4])
    eventually(lambda: agent.acks and agent.acks[-1].watermark == 4)
    refusals = agent.acks[-1].refusals
    assert [refusal.sequence for refusal in refusals] == [2, 3]
    assert "MessagePack" in refusals[0].reason
    assert "came as" in refusals[1].reason
    server.end()
    server.seen.clear()
    server.begin()
    agent.beacon(4)
    eventually(lambda: len(agent.acks) > 1 and agent.acks[-1].refusals == refusals)
    assert server.sequences == [1, 4]
    assert server.store.refused() == 2


def test_a_change_that_cannot_even_be_carried_is_found_and_refused(server: Server, agent: HandAgent) -> None:
    """It spoils every answer that it is in, so the pieces get smaller until it is alone."""
    agent.serve(20)
    agent.log[7] = b"x" * (MAX_CHANGE_BYTES + 1)
    agent.beacon(20)
    eventually(lambda: server.sequences == [s for s in range(1, 21) if s != 7])
    assert [refusal.sequence for refusal in server.store.refusals(MAP)] == [7]


def test_answers_that_are_none_are_asked_again(server: Server, agent: HandAgent) -> None:
    tries: list[int] = []

    def answer(asked: LogRequest) -> LogAnswer | bytes | str:
        tries.append(1)
        wrong: dict[int, LogAnswer | bytes | str] = {
            1: "too busy",
            2: LogAnswer(LOG_ID + 1, 1, 2, ()),
            3: LogAnswer(LOG_ID, 2, 2, ()),
            4: b"garbage",
        }
        return wrong.get(len(tries), agent.answer(asked))

    agent.serve(2, answer)
    agent.beacon(2)
    eventually(lambda: agent.beacon(2) or server.sequences == [1, 2])
    assert len(tries) >= 5
    assert server.store.refused() == 0


def test_an_agent_that_cannot_be_asked_is_asked_less_and_less(server: Server, agent: HandAgent) -> None:
    agent.beacon(5)
    time.sleep(0.5)
    pulls = server.ingest.counters().pulls
    assert 2 <= pulls <= 9, "at 0, 0.02, 0.06, 0.14, 0.24 ... s"
    agent.serve(5)
    eventually(lambda: server.sequences == [1, 2, 3, 4, 5])


def test_a_silent_agent_does_not_hold_up_another(hub: MemoryHub, server: Server, agent: HandAgent) -> None:
    kept: list[Request] = []
    agent.bus.serve(KEYS.log(MAP), kept.append)
    agent.beacon(5)
    eventually(lambda: kept)
    other = HandAgent(hub, MapId("r1", 1))
    other.serve(3)
    other.beacon(3)
    eventually(lambda: server.store.watermark(other.map) == 3, seconds=1)
    other.bus.close()


def test_a_restarted_server_replays_and_goes_on(server: Server, agent: HandAgent) -> None:
    agent.serve(5)
    agent.publish(1)
    agent.publish(2)
    eventually(lambda: server.sequences == [1, 2])
    server.end()
    agent.publish(3)
    server.seen.clear()
    server.begin()
    assert server.sequences == [1, 2], "before anything else"
    agent.beacon(5)
    eventually(lambda: server.sequences == [1, 2, 3, 4, 5])


def test_two_servers_are_each_complete(
    hub: MemoryHub, tmp_path: Path, server: Server, agent: HandAgent
) -> None:
    other = Server(hub, tmp_path / "s1.sqlite", "s1")
    agent.serve(5)
    for sequence in (1, 2, 3, 5):
        agent.publish(sequence)
    eventually(lambda: server.sequences == other.sequences == [1, 2, 3, 4, 5])
    other.end()


def test_a_fresh_epoch_is_another_map(hub: MemoryHub, server: Server, agent: HandAgent) -> None:
    agent.publish(1)
    eventually(lambda: server.sequences == [1])
    fresh = HandAgent(hub, MapId("r0", 4), 78)
    fresh.publish(1)
    fresh.publish(2)
    eventually(lambda: server.store.watermark(fresh.map) == 2)
    assert server.store.watermark(MAP) == 1
    fresh.bus.close()


def test_another_log_under_the_same_name_is_told_so(hub: MemoryHub, server: Server, agent: HandAgent) -> None:
    agent.publish(1)
    eventually(lambda: server.sequences == [1])
    impostor = HandAgent(hub, MAP, LOG_ID + 1)
    impostor.serve(3)
    impostor.publish(2)
    impostor.beacon(3)
    eventually(lambda: len([ack for ack in impostor.acks if ack.log_id == LOG_ID + 1]) == 2)
    ack = impostor.acks[-1]
    reason = "another log goes by the name r0.3 here: begin a fresh map"
    assert (ack.watermark, ack.refusals) == (0, (Refusal(0, reason),))
    assert server.sequences == [1]
    impostor.bus.close()


def test_messages_that_are_none_are_counted_and_change_nothing(server: Server, agent: HandAgent) -> None:
    agent.bus.publish(KEYS.change(MAP), message(1), b"short")
    agent.bus.publish(KEYS.change(MAP), message(1))
    agent.bus.publish(f"{KEYS.root}/agent/R0/change/3", message(1), Mark(1, 1).encode())
    agent.bus.publish(KEYS.head(MAP), b"garbage")
    agent.publish(1, b"x" * 200_000)
    eventually(lambda: server.ingest.counters().damaged == 5)
    agent.publish(1)
    eventually(lambda: server.sequences == [1])


def test_one_who_chokes_on_a_change_gets_the_next(
    server: Server, agent: HandAgent, caplog: pytest.LogCaptureFixture
) -> None:
    def choke(change: Change) -> None:
        server.seen.append(change)
        if change.sequence == 1:
            raise ZeroDivisionError("choked")

    server.on_change = choke
    with caplog.at_level(logging.ERROR):
        agent.publish(1)
        agent.publish(2)
        eventually(lambda: server.sequences == [1, 2])
    assert "choked" in caplog.text


def test_a_disk_that_is_full_for_a_while(
    server: Server, agent: HandAgent, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    agent.serve(3)

    def full(*_: object) -> None:
        raise InvalidFile("s0.sqlite: map store cannot be used (database or disk is full)")

    with monkeypatch.context() as patched, caplog.at_level(logging.ERROR):
        patched.setattr(server.store, "apply", full)
        for sequence in (1, 2, 3):
            agent.publish(sequence)
        eventually(lambda: server.ingest.counters().failures >= 3)
        assert "disk is full" in server.ingest.failure
    assert len(caplog.records) == 1, "one line, not one for each attempt"
    assert not agent.acks
    eventually(lambda: server.sequences == [1, 2, 3])
    assert server.ingest.failure == ""


def test_the_pause_doubles_and_a_sign_of_life_ends_it() -> None:
    one = AgentLog(MAP, 1, PullSettings(grace=0.5, first_pause=1.0, longest_pause=5.0), newest=9)
    assert one.missing(0.0) is None
    assert one.missing(0.4) is None
    assert one.missing(0.5) == LogRequest(1, 9)
    assert one.missing(0.5) is None, "one at a time"
    waits = []
    now = 0.5
    for _ in range(4):
        one.pulled(now, gained=False)
        waits.append(one.pull_at - now)
        now = one.pull_at
        assert one.missing(now) is not None
    assert waits == [1.0, 2.0, 4.0, 5.0]
    one.pulled(now, gained=False)
    one.heard(now)
    assert one.pull_at - now == 1.0


def test_memory_for_what_is_ahead_is_bounded() -> None:
    one = AgentLog(MAP, 1, PullSettings(ahead=10))
    for sequence in range(2, 100):
        one.offer(Entry(sequence, b"", "x"))
    assert len(one.ahead) == 10
    one.offer(Entry(1, b"", "x"))
    assert [entry.sequence for entry in one.next_run()] == list(range(1, 12))
    one.settled(Applied((), (), 5))
    assert min(one.ahead) == 6


def test_what_comes_while_closing_is_no_error(server: Server, agent: HandAgent) -> None:
    for sequence in range(1, 50):
        agent.publish(sequence)
    server.ingest.close()
    server.ingest.close()
    server.ingest._work.put(Sample(KEYS.head(MAP), b""))
