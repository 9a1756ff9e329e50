"""Several servers on one store: all have everything, exactly once and in order; one leads."""

from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.change import Change, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.explainer import ConstraintRecord
from mapweave.mapserver.log import group_commit, postgres_follower
from mapweave.mapserver.log.entry import Applied
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.store import LogChanges
from mapweave.mapserver.map_history import MapHistory
from mapweave.mapserver.server import MapServer
from mapweave.opened_map import open_map
from mapweave.wire.codec import encode_change
from mapweave.wire.memory import MemoryBus, MemoryHub, MessageFaults
from synthetic.postgres_server import PostgresServer
from tests.mapserver.log.acknowledged_fleet import AGENT, KEYS, ROBOTS, SERVER, life
from tests.mapserver.log.test_older_store import PATIENCE, Robot, contents
from tests.mapserver.log.test_store import MAP, entry, node_put
from tests.postgres import absent_standby
from tests.waiting import eventually

Log = list[tuple[int, bytes]]


class FrontServer:
    """An ingest on the shared store."""

    def __init__(self, hub: MemoryHub, address: str, name: str) -> None:
        self.seen: list[Change] = []
        self.bus = MemoryBus(hub)
        self.store = PostgresStore(address, name)
        self.ingest = Ingest(self.bus, KEYS, self.store, name, self.seen.append, SERVER)
        self.store.follow(self.ingest.follow)

    def close(self) -> None:
        self.ingest.close()
        self.bus.close()
        self.store.close()

    def logs(self) -> dict[MapId, Log]:
        """What was passed on, in this order."""
        logs: dict[MapId, Log] = {}
        for change in self.seen:
            logs.setdefault(change.map, []).append((change.sequence, encode_change(change)))
        return logs


@pytest.fixture
def journals(tmp_path: Path) -> Iterator[list[Journal]]:
    journals = [Journal(tmp_path / name, name) for name in ROBOTS]
    yield journals
    for journal in journals:
        journal.close()


def logs_of(journals: list[Journal]) -> dict[MapId, Log]:
    """All that the robots have."""
    return {
        m: [(change.sequence, encode_change(change)) for change in journal.changes(m, 1, journal.head(m))]
        for journal in journals
        for m in journal.maps()
    }


@pytest.mark.parametrize(
    "poll", [1000.0, pytest.param(0.1, marks=pytest.mark.slow)], ids=["notified", "polled"]
)
def test_all_servers_pass_on_everything_once_and_in_order(
    address: str, journals: list[Journal], monkeypatch, poll: float
):
    """Two hear the robots over bad links; a third hears nothing, and a fourth begins late."""
    monkeypatch.setattr(postgres_follower, "POLL", poll)
    if poll < 1.0:
        monkeypatch.setattr(PostgresStore, "_notify", lambda store, connection: None)
    rng = np.random.default_rng(3)
    hub = MemoryHub()
    servers = [FrontServer(hub, address, "s0"), FrontServer(hub, address, "s1")]
    servers.append(FrontServer(MemoryHub(), address, "s2"))
    robots = []
    for journal in journals:
        map_id = journal.open_map(1)
        bus = MemoryBus(hub)
        hub.disturb(MessageFaults(drop=0.2, double=0.2, delay=0.2), rng, bus)
        robot = Replicator(bus, KEYS, journal, map_id, ("s0", "s1"), AGENT)
        robots.append(robot)
        for stamp, body in enumerate(life(map_id, rng, 16)):
            robot.submit([body], stamp)
    late = FrontServer(MemoryHub(), address, "s3")
    servers.append(late)
    for robot in robots:
        assert robot.wait_acknowledged(30)
    expected = logs_of(journals)
    for server in servers:
        eventually(lambda server=server: len(server.seen) >= sum(map(len, expected.values())))
        assert server.logs() == expected
    for robot in robots:
        robot.close()
    for server in servers:
        server.close()


def test_what_one_server_acknowledges_counts_for_all_with_its_store(address: str, journals: list[Journal]):
    hub = MemoryHub()
    servers = [FrontServer(hub, address, name) for name in ("s0", "s1")]
    journal = journals[0]
    map_id = journal.open_map(1)
    robot = Replicator(MemoryBus(hub), KEYS, journal, map_id, ("s0",), AGENT)
    bodies = life(map_id, np.random.default_rng(3), 20)
    robot.submit(bodies[:9], 1)
    assert robot.wait_acknowledged(30)
    servers[0].close()
    robot.submit(bodies[9:], 2)
    assert robot.wait_acknowledged(30), "s1 has the same store"
    assert journal.acknowledged(map_id)["s0"] == len(bodies)
    robot.close()
    servers[1].close()


def test_what_a_promoted_standby_lacks_comes_again_from_robots_that_are_idle(
    address: str, tmp_path, monkeypatch
):
    """It was behind when it was promoted; the server has run on."""
    monkeypatch.setattr(postgres_follower, "POLL", 0.1)
    hub = MemoryHub()
    with ExitStack() as stack:
        store = stack.enter_context(closing(PostgresStore(address, "s0")))
        bus = stack.enter_context(closing(MemoryBus(hub)))
        ingest = stack.enter_context(closing(Ingest(bus, KEYS, store, "s0", lambda change: None)))
        store.follow(ingest.follow)
        robot = stack.enter_context(closing(Robot(hub, tmp_path)))
        robot.send(*(node_put(k) for k in range(1, 8)))
        robot.send(NodeRetired(NodeId(*MAP, 2)), node_put(8))
        assert robot.journal.prune(MAP, ["s0"]) == 2, "neither the node nor its retirement is kept"
        robot.journal.open_map(2)
        other = stack.enter_context(
            closing(Replicator(robot._bus, KEYS, robot.journal, MapId("r0", 2), ("s0",)))
        )
        other.submit([NodePut(replace(node_put(1).node, id=NodeId("r0", 2, 1)))], 1)
        assert other.wait_acknowledged(PATIENCE)
        with psycopg.connect(address) as behind:
            behind.execute("SET search_path TO mapweave")
            behind.execute("DELETE FROM change WHERE epoch = 2 OR sequence > 5")
            behind.execute("DELETE FROM node WHERE epoch = 2 OR number > 5")
            behind.execute("DELETE FROM log WHERE epoch = 2")
            behind.execute("UPDATE log SET watermark = 5")
        wanted = [*robot.journal.replay(MAP)], [*robot.journal.replay(MapId("r0", 2))]
        assert [len(one) for one in wanted] == [7, 1]
        eventually(
            lambda: all(
                contents(change.body for change in store.replay(map_id)) == contents(bodies)
                for map_id, bodies in zip((MAP, MapId("r0", 2)), wanted, strict=True)
            ),
            PATIENCE,
        )
        assert store.watermark(MAP) == 9 and store.unverified(MAP) is None


def test_one_server_leads_and_another_when_it_is_gone(address: str, postgres: PostgresServer):
    stores = [PostgresStore(address, name) for name in ("s0", "s1")]
    assert not any(store.leads for store in stores)
    for store in stores:
        store.follow(lambda news: None)
    eventually(lambda: sum(store.leads for store in stores) == 1)
    (leader,) = (store for store in stores if store.leads)
    (other,) = (store for store in stores if not store.leads)
    # As where its machine loses its power: PostgreSQL ends its session.
    with psycopg.connect(postgres.address(), autocommit=True) as people:
        people.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = %s",
            (f"mapweave {'s0' if leader is stores[0] else 's1'} follows",),
        )
    eventually(lambda: sum(store.leads for store in stores) == 1 and (leader.leads or other.leads))
    (leader,) = (store for store in stores if store.leads)
    (other,) = (store for store in stores if store is not leader)
    leader.close()
    eventually(lambda: other.leads)
    other.close()


@pytest.mark.slow
def test_decisions_on_one_server_reach_the_other(address: str, journals: list[Journal], tmp_path):
    hub = MemoryHub()
    servers = [
        MapServer(MemoryBus(hub), KEYS, address, name, cache=tmp_path / name).__enter__()
        for name in ("s0", "s1")
    ]
    rng = np.random.default_rng(3)
    for journal in journals:
        map_id = journal.open_map(1)
        robot = Replicator(MemoryBus(hub), KEYS, journal, map_id, ("s0", "s1"), AGENT)
        robot.submit(life(map_id, rng, 20), 1)
        assert robot.wait_acknowledged(30)
        robot.close()
    apart = ManualConstraint(Apart((MapId("r0", 1), MapId("r1", 1))), True, "anna", 1, "two kitchens")
    with closing(PostgresStore(address)) as store:
        ConstraintRecord(store).add(apart)
    for server in servers:
        eventually(lambda server=server: len(server.constraints().made) == 1)
        assert server.settle(60)
    nodes = [sorted(server.merged().poses) for server in servers]
    assert nodes[0] == nodes[1] and nodes[0]
    eventually(lambda: sum(bool(server.status()["leads"]) for server in servers) == 1)
    before = content_hash(open_map(address).content)
    for server in servers:
        server.__exit__(None, None, None)
    assert content_hash(open_map(address).content) == before


@pytest.mark.slow
def test_robots_keep_what_they_have_while_postgresql_is_away(
    journals: list[Journal], hub: MemoryHub, own_postgres: PostgresServer
):
    """Also a robot that the server has not known before."""
    server = FrontServer(hub, own_postgres.database(), "s0")
    rng = np.random.default_rng(3)
    maps = [journal.open_map(1) for journal in journals]
    robots = [
        Replicator(MemoryBus(hub), KEYS, journal, map_id, ("s0",), AGENT)
        for journal, map_id in zip(journals, maps, strict=True)
    ]
    robots[0].submit(life(maps[0], rng, 10), 1)
    assert robots[0].wait_acknowledged(30)
    own_postgres.kill()
    for robot, map_id in zip(robots, maps, strict=True):
        robot.submit(life(map_id, rng, 10), 2)
    eventually(lambda: "the map store cannot be used" in server.ingest.failure)
    asked = MemoryBus(hub)
    (answer,) = asked.ask(KEYS.ack("s0", "r1"), b"", 10.0)
    assert "the map store cannot be used" in answer.error, "it cannot know which maps there are"
    assert not any(robot.wait_acknowledged(0.0) for robot in robots)
    own_postgres.start()
    for robot in robots:
        assert robot.wait_acknowledged(60)
    assert server.logs() == logs_of(journals)
    for robot in robots:
        robot.close()
    server.close()


def test_a_commit_that_waits_for_a_standby_is_reported(
    journals: list[Journal], postgres: PostgresServer, monkeypatch
):
    """It neither fails nor ends, so that no error tells of it."""
    monkeypatch.setattr(group_commit, "LONG", 0.5)
    hub = MemoryHub()
    server = FrontServer(hub, postgres.database(), "s0")
    map_id = journals[0].open_map(1)
    robot = Replicator(MemoryBus(hub), KEYS, journals[0], map_id, ("s0",), AGENT)
    rng = np.random.default_rng(3)
    robot.submit(life(map_id, rng, 10), 1)
    assert robot.wait_acknowledged(30) and not server.ingest.failure
    with absent_standby(postgres):
        robot.submit(life(map_id, rng, 10), 2)
        eventually(lambda: "no standby of PostgreSQL confirms" in server.ingest.failure)
        assert not robot.wait_acknowledged(0.0)
    assert robot.wait_acknowledged(60)
    eventually(lambda: not server.ingest.failure)
    robot.close()
    server.close()


def test_a_server_that_freezes_while_it_writes_does_not_hold_up_others(address: str, monkeypatch):
    monkeypatch.setattr(postgres_follower, "STUCK", "1s")
    monkeypatch.setattr(postgres_follower, "POLL", 0.2)
    frozen, other = PostgresStore(address, "s0"), PostgresStore(address, "s1")
    with pytest.raises(InvalidFile), frozen._transaction():
        frozen._begin([LogChanges(MAP, 5, [entry(1)])])
        other.follow(lambda news: None)
        (result,) = other.apply_all([LogChanges(MAP, 5, [entry(1)])])
        assert isinstance(result, Applied), result
    (late,) = frozen.apply_all([LogChanges(MAP, 5, [entry(1), entry(2)])])
    assert isinstance(late, Applied) and (late.before, late.watermark) == (1, 2)
    other.close()
    frozen.close()


def test_a_frozen_server_does_not_lead_for_ever(address: str, monkeypatch):
    monkeypatch.setattr(postgres_follower, "FROZEN", "1s")
    monkeypatch.setattr(postgres_follower, "BEAT", 1000.0)
    frozen = PostgresStore(address, "s0")
    frozen.follow(lambda news: None)
    eventually(lambda: frozen.leads)
    monkeypatch.setattr(postgres_follower, "BEAT", 0.1)
    other = PostgresStore(address, "s1")
    other.follow(lambda news: None)
    eventually(lambda: other.leads)
    eventually(lambda: not frozen.leads)
    other.close()
    frozen.close()


def test_a_leader_that_was_frozen_writes_over_no_record_of_the_one_behind_it(address: str, monkeypatch):
    """It has just looked whether it leads, and goes on where it stood still."""
    monkeypatch.setattr(PostgresStore, "leads", True)
    with closing(PostgresStore(address, "s0")) as store, closing(PostgresStore(address, "s1")) as other:
        frozen = MapHistory(store)
        frozen.failed("first")
        MapHistory(other).failed("second")
        frozen.failed("third")
        assert [event.words for event in MapHistory(other).events] == ["first", "second"]
        assert [event.words for event in frozen.events] == ["first", "second"], "it goes on from there"
        frozen.failed("fourth")
        assert [event.words for event in MapHistory(other).events] == ["first", "second", "fourth"]


def test_what_a_leader_publishes_is_stored_whole(address: str, monkeypatch):
    """Also if more is published while it is stored; and nothing of a server that does not lead."""
    leader, other = PostgresStore(address, "s0"), PostgresStore(address, "s1")
    leader.follow(lambda news: None)
    eventually(lambda: leader.leads)
    other.follow(lambda news: None)
    eventually(lambda: leader.followed and other.leader == "s0")
    assert not other.followed and not other.leads
    other.publish({"a": b"of another"})
    execute, more = psycopg.Connection.execute, [b"second", b"third"]

    def publishing(connection: psycopg.Connection, query: Any, *rest: Any, **how: Any) -> Any:
        """While a result is stored the next are published."""
        if query == postgres_follower.PUBLISH and more:
            value = more.pop(0)
            leader.publish({"a": value, "b": value})
        return execute(connection, query, *rest, **how)

    monkeypatch.setattr(psycopg.Connection, "execute", publishing)
    leader.publish({"a": b"first", "b": b"first"})
    seen = set()

    def stored() -> bool:
        with psycopg.connect(address) as people:
            rows = people.execute("SELECT value FROM mapweave.result WHERE name IN ('a', 'b')").fetchall()
        seen.add(tuple(bytes(value) for (value,) in rows))
        return seen >= {(b"third", b"third")}

    eventually(stored)
    assert all(len({*values}) <= 1 for values in seen), "all at once"
    other.close()
    leader.close()


def test_no_commit_of_changes_waits_for_what_a_leader_publishes(address: str, monkeypatch):
    """One is made while the other transaction is open, and is there before that is."""
    leader = PostgresStore(address, "s0")
    leader.follow(lambda news: None)
    eventually(lambda: leader.leads)
    execute, done = psycopg.Connection.execute, list[tuple[object, bytes | None]]()

    def publishing(connection: psycopg.Connection, query: Any, *rest: Any, **how: Any) -> Any:
        result = execute(connection, query, *rest, **how)
        if query == postgres_follower.PUBLISH:
            (applied,) = leader.apply_all([LogChanges(MAP, 5, [entry(1)])])
            done.append((applied, leader.result("a")))
        return result

    monkeypatch.setattr(psycopg.Connection, "execute", publishing)
    leader.publish({"a": bytes(5_000_000)})
    eventually(lambda: leader.result("a"))
    ((applied, published),) = done
    assert isinstance(applied, Applied) and applied.watermark == 1 and published is None
    leader.close()
