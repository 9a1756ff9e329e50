"""The ingest against agents that are played by hand, so that each mishap can be made to happen."""

import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mapweave.hybridmap.change import Change
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.agent_log import AgentLog, PullSettings
from mapweave.mapserver.log.entry import Applied, ReceivedChange
from mapweave.mapserver.log.inbox import MOST
from mapweave.mapserver.log.ingest_settings import IngestSettings
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.bus import Sample
from mapweave.wire.codec import unwrap_body
from mapweave.wire.log_messages import Ack, LogRequest, StoredChange
from mapweave.wire.memory import MemoryHub
from tests.mapserver.played import KEYS, LOG_ID, MAP, HandAgent, Server
from tests.waiting import eventually


def test_changes_are_applied_and_acknowledged(server: Server, agent: HandAgent):
    agent.publish_each(1, 2, 3)
    eventually(lambda: agent.acks and agent.acks[-1] == Ack(MAP, LOG_ID, 3, (), server.store.id))
    eventually(lambda: server.sequences == [1, 2, 3])
    assert server.store.watermark(MAP) == 3


def test_a_change_is_on_the_disk_before_it_is_acknowledged(server: Server, agent: HandAgent):
    stored: list[int] = []
    server.on_change = lambda change: stored.append(server.store.watermark(MAP) - change.sequence)
    agent.publish(1)
    eventually(lambda: stored)
    assert stored == [0]


def test_a_robot_that_is_reminded_hears_again_what_is_settled_of_that_log(server: Server, agent: HandAgent):
    agent.publish_each(1, 2)
    eventually(lambda: agent.acks and agent.acks[-1].watermark == 2)
    heard = len(agent.acks)
    server.ingest.remind(MapId(MAP.agent, MAP.epoch + 1))
    server.ingest.remind(MAP)
    eventually(lambda: len(agent.acks) > heard)
    assert agent.acks[heard:] == [Ack(MAP, LOG_ID, 2, (), server.store.id)]
    # One that is not settled is acknowledged, or refused, anyway: a reminder would take a refusal back.
    agent.publish(4)
    eventually(lambda: server.ingest.lags()[MAP.agent].missing)
    server.ingest.remind(MAP)
    agent.publish(3)
    eventually(lambda: agent.acks[-1].watermark == 4)
    assert [ack.watermark for ack in agent.acks[heard:]] == [2, 4]


def test_a_reordered_change_waits_for_its_turn_without_being_pulled(
    started: Callable[..., Server], agent: HandAgent
):
    # A busy machine may deliver the next one a good while later.
    server = started(settings=IngestSettings(PullSettings(grace=600.0)))
    agent.publish_each(1, 3, 2, 4)
    eventually(lambda: server.sequences == [1, 2, 3, 4])
    assert server.ingest.counters().pulls == 0


def test_doubles_are_counted_and_dropped(server: Server, agent: HandAgent):
    agent.publish_each(1, 1, 2, 1, 2, 2)
    eventually(lambda: server.ingest.counters().messages == 6)
    eventually(lambda: server.sequences == [1, 2])
    # Each message is counted as such before it turns out to be a double.
    eventually(lambda: server.ingest.counters().doubled == 4)


def test_a_gap_is_pulled_and_only_the_gap(server: Server, agent: HandAgent):
    agent.serve(9)
    agent.publish(1)
    agent.publish_each(5, 6)
    eventually(lambda: server.sequences == [1, 2, 3, 4, 5, 6])
    # With what it has before, by which the agent sees whether that is its log.
    before = zlib.crc32(unwrap_body(agent.log[1])[2])
    assert agent.asked == [LogRequest(2, 4, StoredChange(1, before))]


def test_a_beacon_alone_brings_everything_in_chunks(server: Server, agent: HandAgent):
    agent.serve(600)
    agent.beacon(600)
    eventually(lambda: server.sequences == list(range(1, 601)))
    assert [(asked.first, asked.last) for asked in agent.asked] == [(1, 256), (257, 512), (513, 600)]
    eventually(lambda: agent.acks[-1].watermark == 600)


def test_a_store_that_cannot_be_read_is_no_line_for_each_pull(
    started: Callable[..., Server], agent: HandAgent, monkeypatch, caplog
):
    away, read = [True], SqliteStore.newest_change

    def newest_change(store: SqliteStore, map_id: MapId, watermark: int) -> StoredChange | None:
        if away[0]:
            raise InvalidFile("the store is away")
        return read(store, map_id, watermark)

    monkeypatch.setattr(SqliteStore, "newest_change", newest_change)
    settings = IngestSettings(PullSettings(grace=0.01, first_pause=0.01, longest_pause=0.02))
    server = started(settings=settings)
    agent.serve(3)
    agent.beacon(3)
    eventually(lambda: server.ingest.counters().pulls >= 5)
    assert not agent.asked and "the store is away" not in caplog.text
    away[0] = False
    eventually(lambda: server.sequences == [1, 2, 3])


def test_a_shorter_answer_than_asked_for_goes_on_where_it_ends(server: Server, agent: HandAgent):
    agent.serve(10, lambda asked: agent.answer(LogRequest(asked.first, min(asked.last, asked.first + 2))))
    agent.beacon(10)
    eventually(lambda: server.sequences == list(range(1, 11)))
    assert [asked.first for asked in agent.asked] == [1, 4, 7, 10]


def test_changes_that_the_agent_has_pruned_leave_holes(server: Server, agent: HandAgent):
    agent.serve(8)
    for pruned in (1, 4, 5):
        del agent.log[pruned]
    agent.beacon(8)
    eventually(lambda: server.sequences == [2, 3, 6, 7, 8])
    assert server.store.watermark(MAP) == 8


def test_a_beacon_with_a_low_watermark_gets_another_acknowledgement(server: Server, agent: HandAgent):
    agent.publish(1)
    eventually(lambda: len(agent.acks) == 1)
    agent.beacon(1, s0=1)
    agent.beacon(1, s0=0)
    eventually(lambda: len(agent.acks) == 2)
    agent.beacon(1)
    eventually(lambda: len(agent.acks) == 3)
    assert {ack.watermark for ack in agent.acks} == {1}


@contextmanager
def held_up(server: Server, agent: HandAgent) -> Iterator[None]:
    """The ingest is at the agent's first change until the block ends."""
    held, go_on = threading.Event(), threading.Event()

    def hold(change: Change) -> None:
        held.set()
        assert go_on.wait(30)

    server.on_change = hold
    agent.publish(1)
    assert held.wait(30)
    yield
    go_on.set()


def test_reminders_take_no_room_without_end(server: Server, agent: HandAgent):
    """A robot that declares and takes back a liveliness token over and over has a reminder each time."""
    with held_up(server, agent):
        for _ in range(2 * MOST):
            server.ingest.remind(MAP)
        assert server.ingest.waiting == 1
        for k in range(2 * MOST):
            server.ingest.remind(MapId(MAP.agent, MAP.epoch + k))
        assert server.ingest.waiting <= MOST


def test_beacons_that_wait_become_one(server: Server, agent: HandAgent):
    """Each would be acknowledged, and hold up the changes of others."""
    with held_up(server, agent):
        agent.serve(2)
        for newest in (1, 1, 1, 2, 2):
            agent.beacon(newest)
        eventually(lambda: server.ingest.waiting == 1)
        # The last of them has come.
        agent.publish(2)
        eventually(lambda: server.ingest.waiting == 2)
    eventually(lambda: [ack.watermark for ack in agent.acks][-1:] == [2])
    assert [ack.watermark for ack in agent.acks] == [1, 2]


def test_a_refusal_is_behind_the_acknowledgement_that_a_beacon_asks_for(
    server: Server, agent: HandAgent, monkeypatch
):
    """An acknowledgement behind it would tell the robot that its log is taken again."""
    with held_up(server, agent):
        monkeypatch.setattr(server.ingest, "_objection", lambda body: "not this one")
        agent.publish(2)
        agent.beacon(2)
        eventually(lambda: server.ingest.waiting == 2)
    eventually(lambda: any(ack.refusals for ack in agent.acks))
    eventually(lambda: not server.ingest.waiting and not server.ingest.busy)
    assert [(ack.watermark, bool(ack.refusals)) for ack in agent.acks] == [(1, False), (1, False), (0, True)]


def test_a_restarted_server_replays_and_goes_on(server: Server, agent: HandAgent):
    agent.serve(5)
    agent.publish_each(1, 2)
    eventually(lambda: server.sequences == [1, 2])
    server.end()
    agent.publish(3)
    server.seen.clear()
    server.begin()
    assert server.sequences == [1, 2], "before anything else"
    agent.beacon(5)
    eventually(lambda: server.sequences == [1, 2, 3, 4, 5])


def test_two_servers_are_each_complete(hub: MemoryHub, tmp_path, server: Server, agent: HandAgent):
    other = Server(hub, tmp_path / "s1.sqlite", "s1")
    agent.serve(5)
    agent.publish_each(1, 2, 3, 5)
    eventually(lambda: server.sequences == other.sequences == [1, 2, 3, 4, 5])
    other.end()


def test_a_fresh_epoch_is_another_map(hub: MemoryHub, server: Server, agent: HandAgent):
    agent.publish(1)
    eventually(lambda: server.sequences == [1])
    fresh = HandAgent(hub, MapId("r0", 4), 78)
    fresh.publish(1)
    fresh.publish(2)
    eventually(lambda: server.store.watermark(fresh.map) == 2)
    assert server.store.watermark(MAP) == 1


def test_the_pause_doubles_and_a_sign_of_life_ends_it():
    agent_log = AgentLog(MAP, 1, PullSettings(grace=0.5, first_pause=1.0, longest_pause=5.0), newest=9)
    assert agent_log.missing(0.0) is None
    assert agent_log.missing(0.4) is None
    assert agent_log.missing(0.5) == LogRequest(1, 9)
    assert agent_log.missing(0.5) is None, "one at a time"
    waits = []
    now = 0.5
    for _ in range(4):
        agent_log.pulled(now, gained=False)
        waits.append(agent_log.pull_at - now)
        now = agent_log.pull_at
        assert agent_log.missing(now) is not None
    assert waits == [1.0, 2.0, 4.0, 5.0]
    agent_log.pulled(now, gained=False)
    agent_log.heard(now)
    assert agent_log.pull_at - now == 1.0


def test_memory_for_changes_ahead_is_bounded():
    agent_log = AgentLog(MAP, 1, PullSettings(ahead=10))
    for sequence in range(2, 100):
        agent_log.offer(ReceivedChange(sequence, b"", "x"))
    assert len(agent_log.ahead) == 10
    agent_log.offer(ReceivedChange(1, b"", "x"))
    assert [entry.sequence for entry in agent_log.next_run(0)] == list(range(1, 12))
    agent_log.settled(Applied((), (), 5))
    assert min(agent_log.ahead) == 6


def test_messages_while_closing_are_no_error(server: Server, agent: HandAgent):
    agent.publish_each(*range(1, 50))
    server.ingest.close()
    server.ingest.close()
    server.ingest._hear(Sample(KEYS.head(MAP), b""))
