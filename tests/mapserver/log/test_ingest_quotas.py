"""A robot that floods the ingest: others do not wait for it, and what is held back of it is not lost."""

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.change import Change
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver import quotas as quotas_module
from mapweave.mapserver.log import ingest, intake, kept_bytes, known_logs, pull_schedule, pulled
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.intake import ADVICE, Intake
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import PRUNING_MARK
from mapweave.mapserver.quotas import BURST, Quotas, QuotaSettings
from mapweave.wire.bus import Request
from mapweave.wire.codec import encode_body
from mapweave.wire.log_messages import Refusal
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.clock import Clock
from tests.mapserver.log.acknowledged_fleet import AGENT, edge, node
from tests.mapserver.played import KEYS, LOG_ID, MAP, QUICK, HandAgent, Server
from tests.waiting import eventually

OTHER = MapId("r1", 1)
Start = Callable[..., Server]
Robot = tuple[MapId, Replicator]


@pytest.fixture
def robot(hub: MemoryHub, tmp_path: Path) -> Iterator[Robot]:
    """Of a robot with an empty map: the map, and what sends its changes."""
    journal = Journal(tmp_path / "r0.sqlite", "r0")
    map_id = journal.open_map(1)
    replicator = Replicator(MemoryBus(hub), KEYS, journal, map_id, ["s0"], AGENT)
    yield map_id, replicator
    replicator.close()
    journal.close()


def test_a_flood_of_one_robot_is_no_queue_for_another(hub: MemoryHub, server: Server, agent: HandAgent):
    began, go = threading.Event(), threading.Event()

    def hold(change: Change) -> None:
        server.seen.append(change)
        began.set()
        go.wait(60)

    server.on_change = hold
    other = HandAgent(hub, OTHER)
    agent.publish(1)
    began.wait(60)
    agent.publish_each(*range(2, 400))
    other.publish(1)
    eventually(lambda: len(server.ingest._work._items) == 399)
    go.set()
    eventually(lambda: len(server.seen) == 400)
    place = [change.map for change in server.seen].index(OTHER)
    assert place <= 1, f"{place} changes of the robot that floods went before"


def test_a_pulled_log_is_no_queue_for_another_either(hub: MemoryHub, server: Server, agent: HandAgent):
    other = HandAgent(hub, OTHER)

    def publish_once(change: Change) -> None:
        if not server.seen:
            other.publish(1)
            eventually(lambda: len(server.ingest._work._items))
        server.seen.append(change)

    server.on_change = publish_once
    agent.serve(256)
    agent.beacon(256)
    eventually(lambda: len(server.seen) == 257)
    assert [change.map for change in server.seen].index(OTHER) == pulled.AT_ONE_TURN


def test_what_is_held_back_is_fetched_later_in_order(started: Start, hub: MemoryHub):
    clock = Clock()
    quotas = Quotas(QuotaSettings(changes=10.0), clock)
    server = started(quotas=quotas)
    agent, other = HandAgent(hub, MAP), HandAgent(hub, OTHER)
    at_once = round(10 * BURST)
    agent.serve(300)
    agent.publish_each(*range(1, 301))
    other.publish(1)
    eventually(lambda: server.store.watermark(OTHER) == 1)
    eventually(lambda: "100 changes" in quotas.over().get("r0", ""))
    eventually(lambda: server.store.watermark(MAP) == at_once)
    assert "r1" not in quotas.over()
    for passed in (3.0, 60.0):
        clock.now += passed
        allowed = min(at_once + round(10 * clock.now), 300)
        eventually(lambda allowed=allowed: server.store.watermark(MAP) == allowed)
    # What is committed is handed on a moment later.
    eventually(lambda: len(server.seen) >= 301)
    assert [c.sequence for c in server.seen if c.map == MAP] == list(range(1, 301))
    assert quotas.over() == {}, "it has kept to its quota for a while"


def test_beacons_beyond_the_quota_are_not_looked_at(server: Server):
    """Each of them may cost an answer."""
    clock = Clock()
    quotas = Quotas(QuotaSettings(changes=1.0), clock)
    robot = Intake("r0", quotas, server.store, tuple)
    most = round(BURST)
    assert [robot.beacon() for _ in range(most + 5)] == [True] * most + [False] * 5
    assert "5 beacons" in quotas.over()["r0"]
    clock.now += 3.0
    assert [robot.beacon() for _ in range(5)] == [True] * 3 + [False] * 2


def test_a_robot_that_sends_more_than_its_quota_is_stored_at_the_rate_of_its_quota(
    started: Start, hub: MemoryHub, monkeypatch
):
    """What it publishes behind a gap leaves room for the gap."""
    monkeypatch.setattr(quotas_module, "BURST", 1.0)
    clock = Clock()
    server = started(quotas=Quotas(QuotaSettings(changes=100.0), clock))
    agent = HandAgent(hub, MAP)
    steps, sent, at_once = 20, 0, 100
    agent.serve(at_once + 14 * steps)
    for step in range(steps + 1):
        for _ in range(14 if step else at_once):
            sent += 1
            agent.publish(sent)
        eventually(lambda sent=sent: server.ingest.counters().messages == sent and not server.ingest.busy)
        clock.now += 0.1
    # What is asked for and what is published may come at once, and then take a little of what comes next.
    allowed = at_once + 10 * (steps + 1)
    eventually(lambda: server.store.watermark(MAP) >= allowed - 20)
    assert server.store.watermark(MAP) <= allowed + 20
    clock.now += 10.0
    eventually(lambda: len(server.seen) == sent)
    assert server.sequences == list(range(1, sent + 1))


def test_a_change_that_is_sent_again_and_again_is_shown_and_takes_nothing_from_new_ones(
    started: Start, hub: MemoryHub
):
    clock = Clock()
    quotas = Quotas(QuotaSettings(changes=10.0), clock)
    server = started(quotas=quotas)
    agent = HandAgent(hub, MAP)
    at_once = round(10 * BURST)
    agent.publish(1)
    eventually(lambda: server.store.watermark(MAP) == 1)
    for _ in range(at_once):
        agent.publish(1)
    eventually(lambda: server.ingest.counters().doubled == at_once)
    assert quotas.over() == {}, "as many as there may be new ones"
    for _ in range(150):
        agent.publish(1)
    eventually(lambda: server.ingest.counters().doubled == at_once + 150)
    assert quotas.over() == {"r0": "over its quota: 150 changes"}
    agent.publish_each(*range(2, at_once + 1))
    eventually(lambda: server.store.watermark(MAP) == at_once)
    assert quotas.totals() == {"changes": 150}


def test_one_map_too_many_is_refused_with_the_reason_until_there_is_room(started: Start, hub: MemoryHub):
    server = started(quotas=Quotas(QuotaSettings(maps=3)))
    agents = [HandAgent(hub, MapId("r0", epoch)) for epoch in range(1, 6)]
    for agent in agents:
        agent.serve(2)
        agent.beacon(2)
    eventually(lambda: all(server.store.watermark(agent.map) == 2 for agent in agents[:3]))
    # The others are answered a moment later.
    eventually(lambda: all(any(ack.map == agent.map for ack in agent.acks) for agent in agents[3:]))
    reason = f"r0 has 3 maps here, which is its quota: {ADVICE} `maps`"
    for agent in agents[3:]:
        refusals = [ack.refusals for ack in agent.acks if ack.map == agent.map]
        assert refusals and set(refusals) == {(Refusal(0, reason),)}
    other = HandAgent(hub, OTHER)
    other.publish(1)
    eventually(lambda: server.store.watermark(OTHER) == 1)
    agents[0].publish(3)
    eventually(lambda: server.store.watermark(agents[0].map) == 3)
    assert len(server.store.maps()) == 4
    server.quotas = None
    server.restart()
    eventually(lambda: [agent.beacon(2) for agent in agents] and len(server.store.maps()) == 6)


def test_nodes_beyond_the_quota_stay_on_the_robot_until_there_is_room(
    started: Start, robot: Robot, monkeypatch
):
    monkeypatch.setattr(ingest, "QUOTA_PAUSE", 0.05)
    server = started(quotas=Quotas(QuotaSettings(nodes=10)))
    map_id, replicator = robot
    rng = np.random.default_rng(1)
    puts = [node(map_id, number, rng) for number in range(1, 16)]
    again = [node(map_id, number, rng) for number in range(1, 6)]
    replicator.submit([*puts[:5], *again, *puts[5:]], 1)
    eventually(lambda: "r0 has 10 nodes" in replicator.status().failure)
    assert server.store.watermark(map_id) == 15, "ten nodes, five of them twice"
    assert replicator.unacknowledged() == 5
    server.quotas = Quotas(QuotaSettings(nodes=15))
    server.restart()
    assert replicator.wait_acknowledged(60)
    eventually(lambda: not replicator.status().failure)
    assert [c.sequence for c in server.seen if c.map == map_id][-5:] == [16, 17, 18, 19, 20]


def test_edges_beyond_the_quota_stay_on_the_robot_until_there_is_room(
    started: Start, robot: Robot, monkeypatch
):
    """Two nodes may have as many edges as one likes, and each costs every merge: that of all robots."""
    monkeypatch.setattr(ingest, "QUOTA_PAUSE", 0.05)
    monkeypatch.setattr(intake, "DRIVEN", 10)
    monkeypatch.setattr(intake, "EDGES", 2)
    server = started()
    map_id, replicator = robot
    rng = np.random.default_rng(1)
    nodes = [node(map_id, number, rng) for number in (1, 2)]
    again = [edge(map_id, 3 + number % 5, 1, 2) for number in range(40)]
    replicator.submit([*nodes, *again], 1)
    assert replicator.wait_acknowledged(60), "forty changes of five edges"
    replicator.submit([edge(map_id, number, 1, 2) for number in range(8, 30)], 1)
    eventually(lambda: "edges here, which is its quota" in replicator.status().failure)
    kept = server.store.edges("r0")[map_id]
    assert 14 <= kept <= 15 and replicator.unacknowledged() == 27 - kept
    monkeypatch.setattr(intake, "DRIVEN", 100)
    assert replicator.wait_acknowledged(60)


def test_a_node_that_is_put_again_and_again_fills_no_disk(started: Start, robot: Robot, monkeypatch):
    monkeypatch.setattr(kept_bytes, "LEAST_GROWN", 20_000)
    server = started()
    map_id, replicator = robot
    rng = np.random.default_rng(1)
    start = [node(map_id, 1, rng), node(map_id, 2, rng), edge(map_id, 3, 1, 2)]
    again = [node(map_id, 2, rng) for _ in range(300)]
    sent = sum(len(encode_body(body)) for body in again)
    replicator.submit([*start, *again], 1)
    assert replicator.wait_acknowledged(60)
    assert sent > 4 * server.store.stored_bytes(map_id, 0, 303), "most of it is superseded"
    server.restart()
    replicator.submit([edge(map_id, 4, 1, 2)], 1)
    assert replicator.wait_acknowledged(60)
    assert server.store.stored_bytes(map_id, 0, 304) < 40_000, "once more after a start"
    kept = HybridMap(change.body for change in server.store.replay(map_id))
    wanted = HybridMap([*start, *again, edge(map_id, 4, 1, 2)])
    assert {encode_body(b) for b in kept.contents()} == {encode_body(b) for b in wanted.contents()}


def test_bytes_beyond_the_quota_stay_on_the_robot_until_there_is_room(
    started: Start, robot: Robot, hub: MemoryHub, monkeypatch
):
    monkeypatch.setattr(ingest, "QUOTA_PAUSE", 0.05)
    monkeypatch.setattr(kept_bytes, "LEAST_GROWN", 10_000)
    server = started(quotas=Quotas(QuotaSettings(megabytes=0.2)))
    map_id, replicator = robot
    rng = np.random.default_rng(1)
    replicator.submit([node(map_id, number, rng) for number in range(1, 101)], 1)
    eventually(lambda: "`megabytes`" in replicator.status().failure)
    assert "MB of changes here, which is its quota" in replicator.status().failure
    kept = server.store.watermark(map_id)
    assert 10 < kept < 80 and server.store.stored_bytes(map_id, 0, kept) <= 200_000
    other = HandAgent(hub, OTHER)
    other.publish(1)
    eventually(lambda: server.store.watermark(OTHER) == 1)
    # That its map is retired makes room for its next, and not for more of this one.
    server.retired.add(map_id)
    following = HandAgent(hub, MapId("r0", 9))
    following.serve(5)
    following.beacon(5)
    eventually(lambda: server.store.watermark(following.map) == 5)
    assert server.store.watermark(map_id) == kept and replicator.unacknowledged() == 100 - kept
    server.quotas = Quotas(QuotaSettings(megabytes=1.0))
    server.restart()
    assert replicator.wait_acknowledged(60)


def test_what_was_pruned_makes_room_for_the_robot(started: Start, robot: Robot, monkeypatch):
    """Also where its map grows no more, and where another server has pruned it."""
    monkeypatch.setattr(ingest, "QUOTA_PAUSE", 0.05)
    server = started(quotas=Quotas(QuotaSettings(megabytes=0.2)))
    map_id, replicator = robot
    rng = np.random.default_rng(1)
    replicator.submit([node(map_id, number, rng) for number in range(1, 61)], 1)
    eventually(lambda: "`megabytes`" in replicator.status().failure)
    nodes = [NodeId(*map_id, number) for number in range(1, server.store.watermark(map_id) + 1)]
    assert server.store.prune(nodes, [], {PRUNING_MARK: b"1"})
    assert replicator.wait_acknowledged(60) and not replicator.status().failure


def test_logs_that_never_answer_do_not_hold_up_one_that_does(
    started: Start, hub: MemoryHub, agent: HandAgent
):
    """They are waited for longer than this test takes, and more of them than are asked at once."""
    server = started(settings=replace(QUICK, ask_timeout=600.0))
    agent.publish(1)
    eventually(lambda: agent.acks)
    kept: list[Request] = []
    silent = HandAgent(hub, MapId("x0", 1))
    for number in range(60):
        silent.map = MapId(f"x{number}", 1)
        silent.bus.serve(KEYS.log(silent.map), kept.append)
        silent.beacon(5)
    eventually(lambda: len(kept) >= pull_schedule.SILENT_AT_ONCE)
    agent.serve(5)
    agent.beacon(5)
    eventually(lambda: server.sequences == [1, 2, 3, 4, 5])
    assert len(kept) == pull_schedule.SILENT_AT_ONCE


def test_names_alone_fill_no_memory(hub: MemoryHub, server: Server, agent: HandAgent):
    crowd = HandAgent(hub, OTHER)
    for number in range(3 * known_logs.MOST_UNKNOWN):
        crowd.map = MapId(f"x{number}", number % 7)
        crowd.beacon(0)
        if number % 500 == 0:
            # They come faster than the inbox has room for.
            eventually(lambda: not len(server.ingest._work._items))
    agent.publish(1)
    eventually(lambda: server.sequences == [1])
    eventually(lambda: not len(server.ingest._work._items))
    assert len(server.ingest._logs) <= known_logs.MOST_UNKNOWN + 1


def test_a_beacon_beyond_all_logs_moves_only_its_own(hub: MemoryHub, server: Server, agent: HandAgent):
    """It says 2^53 and answers with nothing, as if all that was pruned: that ends its own map alone."""
    agent.serve(2)
    agent.publish(1)
    other = HandAgent(hub, MapId("r0", MAP.epoch + 1))
    other.serve(2)
    agent.beacon(2**53)
    other.beacon(2)
    eventually(lambda: server.store.watermark(other.map) == 2)
    fresh = HandAgent(hub, OTHER)
    fresh.publish(1)
    eventually(lambda: server.store.watermark(OTHER) == 1)
    assert server.store.watermark(MAP) <= 2, "it has given no more than two"


def test_undecodable_changes_fill_no_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.log.store.MOST_REFUSED_KEPT", 5)
    store = SqliteStore(tmp_path / "s0.sqlite")
    entries = [ReceivedChange.read(MAP, sequence, b"\xc1" * 100_000) for sequence in range(1, 51)]
    store.apply(MAP, LOG_ID, entries)
    assert store.refused() == store.watermark(MAP) == 50
    assert store.refusals(MAP, 1)[0].reason
    store.close()
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 2_000_000


def test_a_robot_whose_changes_are_all_refused_fills_no_log(server: Server, agent: HandAgent, caplog):
    caplog.set_level(logging.INFO, "mapweave.mapserver")
    agent.serve(1, lambda asked: agent.answer(asked))
    for sequence in range(1, 41):
        agent.log[sequence] = b"\xc1" * 50
        agent.publish(sequence, b"\xc1" * 50)
    agent.beacon(40)
    eventually(lambda: agent.acks and agent.acks[-1].watermark == 40)
    server.end()
    said = [record.getMessage() for record in caplog.records]
    assert [line[:12] for line in said if line.startswith("refused ")] == [f"refused {MAP}"[:12]]
    assert len([line for line in said if "came damaged" in line]) == 1
    assert len(agent.acks[-1].refusals) == 16, "the robot hears why"
