"""The replicator against servers that are played by hand."""

import logging
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.replication import replicator
from mapweave.agent.replication.journal import Draft, Journal
from mapweave.agent.replication.log_state import MOST_SERVERS, SequenceRanges
from mapweave.agent.replication.replicator import ReplicationSettings, Replicator
from mapweave.hybridmap.agent_status import FIRST_STATUS_PERIOD
from mapweave.hybridmap.change import ChangeBody, NodeRetired
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.wire.bus import Sample
from mapweave.wire.codec import decode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Ack, Head, LogAnswer, LogRequest, Mark, Refusal, StoredChange
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.packing import pack
from tests.waiting import eventually

KEYS = Keys("fleet")
MAP = MapId("r0", 1)
QUICK = ReplicationSettings(beacon_interval=0.03, answer_bytes=2000, retry_interval=0.05)


def bodies(first: int, last: int) -> list[ChangeBody]:
    return [NodeRetired(NodeId(*MAP, number)) for number in range(first, last + 1)]


class HandServer:
    """Listens, and acknowledges what the test says."""

    def __init__(self, hub: MemoryHub, name: str = "s0") -> None:
        self.bus, self.name = MemoryBus(hub), name
        self.changes: list[Sample] = []
        self.heads: list[Head] = []
        self.bus.subscribe(KEYS.changes(), self.changes.append)
        self.bus.subscribe(KEYS.heads(), lambda sample: self.heads.append(Head.decode(sample.payload)))

    def acknowledge(
        self, log_id: int, watermark: int, *refusals: Refusal, store: int = 0, period: float = 0.0
    ) -> None:
        ack = Ack(MAP, log_id, watermark, refusals, store, period)
        self.bus.publish(KEYS.ack(self.name, "r0"), ack.encode())

    def ask(self, first: int, last: int) -> LogAnswer:
        (reply,) = self.bus.ask(KEYS.log(MAP), pack({"f": first, "q": last}), 5)
        if reply.error:
            raise InvalidMessage(reply.error)
        return LogAnswer.decode(reply.payload)


class Agent:
    def __init__(self, hub: MemoryHub, path: Path, servers: tuple[str, ...] = ("s0",)) -> None:
        self.bus = MemoryBus(hub)
        self.journal = Journal(path, "r0")
        self.map = self.journal.open_map(1)
        self.replicator = Replicator(self.bus, KEYS, self.journal, self.map, servers, QUICK)
        self.log_id = self.journal.log_id(self.map)

    def commit(self, first: int, last: int) -> None:
        """Changes that are on its disk then."""
        self.replicator.submit(bodies(first, last), 0)
        assert self.replicator.flush(30)

    def close(self) -> None:
        self.replicator.close()
        self.bus.close()
        self.journal.close()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r0.sqlite"


@pytest.fixture
def agent(hub: MemoryHub, path: Path, opened) -> Agent:
    return opened(Agent(hub, path))


@pytest.fixture
def server(hub: MemoryHub) -> HandServer:
    return HandServer(hub)


def test_changes_are_published_in_order_with_their_mark(agent: Agent, server: HandServer):
    agent.replicator.submit(bodies(1, 3), 10)
    agent.replicator.submit(bodies(4, 4), 20)
    eventually(lambda: len(server.changes) == 4)
    marks = [Mark.decode(sample.attachment) for sample in server.changes]
    assert marks == [Mark(k, agent.log_id) for k in (1, 2, 3, 4)]
    changes = [decode_change(sample.payload) for sample in server.changes]
    assert [(c.map, c.sequence, c.stamp_ns) for c in changes] == [
        (MAP, 1, 10), (MAP, 2, 10), (MAP, 3, 10), (MAP, 4, 20),
    ]  # fmt: skip
    assert {sample.key for sample in server.changes} == {KEYS.change(MAP)}


def test_the_longest_status_period_that_servers_want_counts(agent: Agent, hub: MemoryHub):
    first, second = HandServer(hub), HandServer(hub, "s1")
    assert agent.replicator.status_period == FIRST_STATUS_PERIOD, "none has said anything"
    first.acknowledge(agent.log_id, 0, period=2.5)
    eventually(lambda: agent.replicator.status_period == 2.5)
    second.acknowledge(agent.log_id, 0, period=1.0)
    first.acknowledge(agent.log_id, 0, period=0.75)
    eventually(lambda: agent.replicator.status_period == 1.0)
    second.acknowledge(agent.log_id, 0)
    eventually(lambda: agent.replicator.status_period == 0.75)
    first.acknowledge(agent.log_id, 0)
    eventually(lambda: agent.replicator.status_period == 0.0)
    first.bus.close()
    second.bus.close()


def test_the_disk_comes_first(hub: MemoryHub, path: Path, opened):
    """A published change is in the journal."""
    agent = opened(Agent(hub, path))
    on_disk: list[bool] = []
    server = MemoryBus(hub)
    server.subscribe(KEYS.changes(), lambda s: on_disk.append(agent.journal.head(MAP) >= len(on_disk) + 1))
    for k in range(1, 30):
        agent.replicator.submit(bodies(k, k), 0)
    eventually(lambda: len(on_disk) == 29)
    assert all(on_disk)


def test_submitting_never_waits_for_the_disk(agent: Agent, monkeypatch):
    release = threading.Event()
    write = agent.journal.write

    def slow(map_id: MapId, drafts: list[Draft]) -> int:
        release.wait(60)
        return write(map_id, drafts)

    monkeypatch.setattr(agent.journal, "write", slow)
    begin = time.monotonic()
    for k in range(1, 51):
        agent.replicator.submit(bodies(k, k), 0)
    assert time.monotonic() - begin < 20
    assert not agent.replicator.flush(0.05)
    assert agent.replicator.status().waiting == 50
    release.set()
    assert agent.replicator.flush(30)
    assert agent.replicator.status().waiting == 0
    assert agent.journal.head(MAP) == 50


def test_a_change_that_cannot_be_encoded_is_refused_at_once(agent: Agent):
    for bad in (NodeRetired(NodeId("r0", 1, -1)), NodeRetired(NodeId("r1", 1, 1))):
        with pytest.raises(InvalidValue):
            agent.replicator.submit([*bodies(1, 2), bad], 0)
    assert agent.replicator.flush(30)
    assert agent.journal.head(MAP) == 0


def test_a_flood_of_acknowledgements_holds_up_no_change_and_fills_no_memory(agent: Agent, monkeypatch):
    """Of a server that lies, or of any program without keys: nothing reached the disk while it lasted."""
    over, again = threading.Event(), Sample(KEYS.ack("s0", "r0"), Ack(MAP, agent.log_id, 0).encode())
    take, most = agent.replicator._take_ack, [0]

    def send() -> None:
        agent.replicator._hear(again)
        most[0] = max(most[0], agent.replicator._work.qsize())

    def take_while_more_come(sample: Sample) -> None:
        for _ in range(0 if over.is_set() else 2):
            send()
        take(sample)

    monkeypatch.setattr(replicator, "MOST_WAITING", 16)
    monkeypatch.setattr(replicator, "MOST_AT_ONCE", 4)
    monkeypatch.setattr(agent.replicator, "_take_ack", take_while_more_come)
    send()
    try:
        eventually(lambda: most[0] >= 16)
        agent.replicator.submit(bodies(1, 3), 0)
        assert agent.replicator.flush(5.0)
    finally:
        over.set()
    assert most[0] <= 18, "and what was submitted"


def test_a_server_that_lies_fills_no_log_and_no_memory(agent: Agent, hub: MemoryHub, caplog):
    """Garbage, refusals of changes that there are not, a new store each time, and any number of names."""
    agent.commit(1, 3)
    liar, state = MemoryBus(hub), agent.replicator._logs[MAP]
    refusals = tuple(Refusal(sequence, "no") for sequence in range(4, 12))
    with caplog.at_level(logging.WARNING):
        for k in range(300):
            liar.publish(KEYS.ack("s0", "r0"), bytes([k % 256, k % 7]))
            for watermark in (3, 0):
                ack = Ack(MAP, agent.log_id, watermark, refusals, store=2 * k + watermark + 1)
                liar.publish(KEYS.ack("s0", "r0"), ack.encode())
            liar.publish(KEYS.ack(f"x{k}", "r0"), Ack(MAP, agent.log_id, 1).encode())
        eventually(lambda: agent.replicator._work.qsize() == 0)
    assert len(caplog.records) <= 2, [record.message for record in caplog.records]
    assert not state.refusals and len(state.acknowledged) <= MOST_SERVERS and len(state.left) <= MOST_SERVERS
    # The server that is to have everything is heard as before.
    liar.publish(KEYS.ack("s0", "r0"), Ack(MAP, agent.log_id, 3, store=10**6).encode())
    eventually(lambda: agent.replicator.status().unacknowledged == 0)
    liar.close()


def test_a_server_that_says_that_the_disk_was_put_back_is_believed(agent: Agent, hub: MemoryHub):
    """Its word alone ends that a map is sent; what is mapped reaches the own disk all the same."""
    agent.commit(1, 3)
    liar = MemoryBus(hub)
    liar.publish(KEYS.ack("s0", "r0"), Ack(MAP, agent.log_id, 3, stored=StoredChange(3, 7)).encode())
    eventually(lambda: "begin a fresh map" in agent.replicator.status().failure)
    agent.replicator.submit(bodies(4, 5), 0)
    assert agent.replicator.flush(30) and agent.replicator.status().newest == 5


def test_a_question_for_which_there_is_no_room_is_refused(agent: Agent, hub: MemoryHub, monkeypatch):
    monkeypatch.setattr(replicator, "MOST_WAITING", 0)
    (reply,) = MemoryBus(hub).ask(KEYS.log(MAP), pack({"f": 1, "q": 1}), 5)
    assert reply.error == "r0 is asked too much at once" and reply.retry_after == 1.0


def test_a_full_disk_is_logged_once_and_retried(agent: Agent, server: HandServer, monkeypatch, caplog):
    tries: list[int] = []

    def full(*_: object) -> None:
        tries.append(1)
        raise InvalidFile("r0.sqlite: agent journal cannot be used (database or disk is full)")

    with monkeypatch.context() as patched, caplog.at_level(logging.ERROR):
        patched.setattr(agent.journal, "write", full)
        agent.replicator.submit(bodies(1, 2), 0)
        eventually(lambda: len(tries) >= 3)
        agent.replicator.submit(bodies(3, 3), 0)
        assert "disk is full" in agent.replicator.status().failure
    assert len(caplog.records) == 1
    assert not server.changes
    assert agent.replicator.flush(30)
    assert agent.replicator.status().failure == ""
    eventually(lambda: [Mark.decode(s.attachment).sequence for s in server.changes] == [1, 2, 3])


def test_a_full_disk_that_takes_no_acknowledgement_either_is_one_line(
    agent: Agent, server: HandServer, monkeypatch, caplog
):
    """A server says again and again what it has, until the robot has noted it."""
    agent.commit(1, 2)
    tries: list[int] = []

    def full(*_: object, **__: object) -> None:
        tries.append(1)
        raise InvalidFile("r0.sqlite: agent journal: the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(agent.journal, "acknowledge", full)
        patched.setattr(agent.journal, "write", full)
        for count in range(1, 4):
            server.acknowledge(agent.log_id, 2)
            eventually(lambda count=count: len(tries) == count)
        agent.replicator.submit(bodies(3, 3), 0)
        eventually(lambda: "disk is full" in agent.replicator.status().failure)
    (record,) = caplog.records
    assert record.getMessage() == "r0.sqlite: agent journal: the disk is full"
    assert agent.replicator.flush(30)
    server.acknowledge(agent.log_id, 3)
    assert agent.replicator.wait_acknowledged(30)
    with monkeypatch.context() as patched:
        patched.setattr(agent.journal, "write", full)
        agent.replicator.submit(bodies(4, 4), 0)
        eventually(lambda: len(caplog.records) == 2)


def test_closing_commits_what_was_submitted(hub: MemoryHub, path: Path, opened):
    agent = Agent(hub, path)
    agent.replicator.submit(bodies(1, 100), 0)
    agent.close()
    journal = opened(Journal(path, "r0"))
    assert journal.head(MAP) == 100


def test_the_beacon_has_the_length_of_the_log_and_the_watermarks(agent: Agent, server: HandServer):
    eventually(lambda: server.heads)
    assert server.heads[0] == Head(agent.log_id, 0, {})
    agent.replicator.submit(bodies(1, 3), 0)
    eventually(lambda: server.heads[-1].newest == 3)
    server.acknowledge(agent.log_id, 2)
    eventually(lambda: server.heads[-1] == Head(agent.log_id, 3, {"s0": 2}))
    count = len(server.heads)
    eventually(lambda: len(server.heads) >= count + 3)


def test_a_slow_server_gets_no_beacons_for_what_is_on_its_way(agent: Agent, server: HandServer):
    """Its acknowledgements take ten times as long as the shortest time to a beacon."""

    def beacons_until_acknowledged(sequence: int) -> int:
        agent.replicator.submit(bodies(sequence, sequence), 0)
        eventually(lambda: len(server.changes) == sequence)
        time.sleep(10 * QUICK.beacon_interval)
        if sequence == 1:
            eventually(lambda: sum(head.newest == 1 for head in server.heads) >= 2)
        lacking = sum(head.newest == sequence for head in server.heads)
        server.acknowledge(agent.log_id, sequence)
        assert agent.replicator.wait_acknowledged(30)
        return lacking

    _, *rest = [beacons_until_acknowledged(sequence) for sequence in range(1, 9)]
    # The one that all maps have from time to time may be among them.
    assert sorted(rest)[len(rest) // 2] <= 1


def test_who_waits_for_acknowledgements_does_not_wait_for_beacons(agent: Agent, server: HandServer):
    """A slow hour is over, and a change is lost: the robot's owner wants to switch it off."""
    for sequence in range(1, 4):
        agent.replicator.submit(bodies(sequence, sequence), 0)
        eventually(lambda sequence=sequence: len(server.changes) == sequence)
        time.sleep(20 * QUICK.beacon_interval)
        server.acknowledge(agent.log_id, sequence)
        assert agent.replicator.wait_acknowledged(30)
    agent.commit(4, 4)
    before = len(server.heads)
    began = time.monotonic()
    assert not agent.replicator.wait_acknowledged(30 * QUICK.beacon_interval)
    # After 1, 3, 7, 11 and so on intervals: overdue it is after 20 and more.
    assert len(server.heads) - before >= 3
    assert time.monotonic() - began >= 30 * QUICK.beacon_interval


def test_acknowledgements_are_waited_for(hub: MemoryHub, path: Path, server: HandServer):
    agent = Agent(hub, path, ("s0", "s1"))
    agent.commit(1, 3)
    assert not agent.replicator.wait_acknowledged(0.05)
    server.acknowledge(agent.log_id, 3)
    other = HandServer(hub, "s1")
    other.acknowledge(agent.log_id, 2)
    eventually(lambda: agent.journal.acknowledged(MAP) == {"s0": 3, "s1": 2})
    assert not agent.replicator.wait_acknowledged(0.05)
    assert agent.replicator.status().unacknowledged == 1
    other.acknowledge(agent.log_id, 3)
    assert agent.replicator.wait_acknowledged(30)
    assert agent.replicator.status().unacknowledged == 0
    agent.close()
    other.bus.close()


def test_acknowledgements_are_waited_for_while_that_is_worthwhile(agent: Agent, server: HandServer):
    agent.commit(1, 3)
    before, looks = len(server.heads), iter([True, True, False])
    began = time.monotonic()
    assert not agent.replicator.wait_acknowledged(30, lambda: next(looks))
    assert not list(looks) and time.monotonic() - began < 30
    # Beacons go on meanwhile.
    assert len(server.heads) > before
    server.acknowledge(agent.log_id, 3)
    assert agent.replicator.wait_acknowledged(30)
    assert agent.replicator.wait_acknowledged(30, lambda: False), "nothing is waited for"


def test_without_required_servers_any_will_do(hub: MemoryHub, path: Path, server: HandServer, opened):
    agent = opened(Agent(hub, path, ()))
    agent.commit(1, 3)
    assert not agent.replicator.wait_acknowledged(0.05)
    server.acknowledge(agent.log_id, 3)
    assert agent.replicator.wait_acknowledged(30)


def test_old_and_foreign_acknowledgements_change_nothing(agent: Agent, server: HandServer):
    agent.commit(1, 3)
    server.acknowledge(agent.log_id, 2)
    server.acknowledge(agent.log_id, 1)
    server.acknowledge(agent.log_id + 1, 3)
    server.bus.publish(KEYS.ack("s0", "r0"), Ack(MapId("r0", 9), agent.log_id, 3).encode())
    server.bus.publish(KEYS.ack("s0", "r0"), b"garbage")
    server.bus.publish(KEYS.ack("s9", "r0"), Ack(MAP, agent.log_id, 1).encode())
    eventually(lambda: agent.journal.acknowledged(MAP) == {"s0": 2, "s9": 1})


@pytest.mark.parametrize("again", [False, True])
def test_a_server_that_has_lost_its_store_lacks_everything_again(
    hub: MemoryHub, path: Path, server: HandServer, again: bool, caplog
):
    agent = Agent(hub, path)
    agent.commit(1, 3)
    server.acknowledge(agent.log_id, 3, store=5)
    server.acknowledge(agent.log_id, 1, store=5)
    assert agent.replicator.wait_acknowledged(30)
    if again:
        agent.close()
        agent = Agent(hub, path)
    assert agent.replicator.status().unacknowledged == 0
    server.acknowledge(agent.log_id, 1, store=6)
    eventually(lambda: agent.replicator.status().unacknowledged == 2)
    assert agent.journal.acknowledged(MAP) == {"s0": 1}
    assert "s0 has lost what it had of r0.1 after 1" in caplog.text
    server.acknowledge(agent.log_id, 3, store=6)
    assert agent.replicator.wait_acknowledged(30)
    agent.close()


def test_a_late_acknowledgement_of_a_store_that_is_lost_says_nothing(
    hub: MemoryHub, path: Path, server: HandServer, monkeypatch, opened
):
    """The robot would drop retirements that the new store has never had."""
    agent = opened(Agent(hub, path))
    agent.commit(1, 3)
    server.acknowledge(agent.log_id, 3, store=5)
    assert agent.replicator.wait_acknowledged(30)
    server.acknowledge(agent.log_id, 1, store=6)
    eventually(lambda: agent.replicator.status().unacknowledged == 2)
    # On their way since before the store was lost; what s9 says shows that they were heard.
    for _ in range(2):
        server.acknowledge(agent.log_id, 3, store=5)
    server.bus.publish(KEYS.ack("s9", "r0"), Ack(MAP, agent.log_id, 1).encode())
    eventually(lambda: "s9" in agent.journal.acknowledged(MAP))
    assert agent.journal.acknowledged(MAP) == {"s0": 1, "s9": 1}
    server.acknowledge(agent.log_id, 2, store=6)
    eventually(lambda: agent.replicator.status().unacknowledged == 1)
    # A backup of the former store was put back.
    monkeypatch.setattr("mapweave.agent.replication.log_state.LATE", 0.0)
    server.acknowledge(agent.log_id, 3, store=5)
    assert agent.replicator.wait_acknowledged(30)


def test_a_server_that_has_more_than_the_disk(agent: Agent, server: HandServer, caplog):
    agent.commit(1, 3)
    with caplog.at_level(logging.WARNING):
        server.acknowledge(agent.log_id, 9)
        eventually(lambda: "begin a fresh map" in agent.replicator.status().failure)
    assert agent.journal.acknowledged(MAP) == {}
    assert agent.replicator.status().unacknowledged == 3


def test_refusals_are_logged_once(agent: Agent, server: HandServer, caplog):
    agent.commit(1, 3)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            server.acknowledge(agent.log_id, 3, Refusal(2, "landmark 9 is not there"))
        eventually(lambda: agent.replicator.status().unacknowledged == 0)
        server.acknowledge(agent.log_id, 3, Refusal(0, "another log"))
        eventually(lambda: agent.replicator.status().failure == "s0: another log")
    assert agent.replicator.refusals() == {("s0", 2): "landmark 9 is not there", ("s0", 0): "another log"}
    assert [record.message for record in caplog.records] == [
        "s0 refuses r0.1 2: landmark 9 is not there",
        "s0 refuses r0.1 0: another log",
    ]


def test_the_log_answers_for_ranges(agent: Agent, server: HandServer):
    agent.commit(1, 30)
    answer = server.ask(4, 6)
    assert (answer.log_id, answer.first, answer.covered) == (agent.log_id, 4, 6)
    assert [(s, decode_change(data).sequence) for s, data in answer.changes] == [(4, 4), (5, 5), (6, 6)]
    assert server.ask(29, 99).covered == 30
    assert server.ask(31, 40) == LogAnswer(agent.log_id, 31, 30, ())
    with pytest.raises(InvalidMessage, match="log request"):
        server.ask(5, 4)


def test_the_log_answers_in_pieces(agent: Agent, server: HandServer):
    """Not more than 256 changes, and not more than the settings' bytes."""
    agent.commit(1, 600)
    collected: list[int] = []
    while len(collected) < 600:
        answer = server.ask(len(collected) + 1, 600)
        assert 1 <= len(answer.changes) <= 256
        assert sum(len(data) for _, data in answer.changes) <= 2000
        assert answer.covered == answer.changes[-1][0]
        collected += [sequence for sequence, _ in answer.changes]
    assert collected == list(range(1, 601))


def test_a_map_that_was_left_is_still_handed_over(hub: MemoryHub, path: Path, server: HandServer):
    agent = Agent(hub, path)
    agent.replicator.submit(bodies(1, 3), 0)
    agent.close()
    old_id = agent.log_id
    bus, journal = MemoryBus(hub), Journal(path, "r0")
    fresh = journal.open_map(None)
    server.heads.clear()
    replicator = Replicator(bus, KEYS, journal, fresh, ("s0",), QUICK)
    eventually(lambda: Head(old_id, 3) in server.heads[-3:])
    assert replicator.status().unacknowledged == 3
    assert [sequence for sequence, _ in server.ask(1, 9).changes] == [1, 2, 3]
    server.acknowledge(old_id, 3)
    assert replicator.wait_acknowledged(30)
    replicator.submit([NodeRetired(NodeId("r0", fresh.epoch, 1))], 0)
    server.heads.clear()
    eventually(lambda: len(server.heads) > 12)
    assert sum(head.log_id == old_id for head in server.heads) <= 2, "it is complete: rarely a beacon"
    server.bus.publish(KEYS.ack("s0", "r0"), Ack(fresh, journal.log_id(fresh), 1, (), 0).encode())
    assert replicator.wait_acknowledged(30)
    server.heads.clear()
    alive = server.bus.announce(KEYS.server_alive("s0"))
    eventually(lambda: {head.log_id for head in server.heads[-3:]} == {old_id, journal.log_id(fresh)})
    assert len(server.heads) < 12, "a server that comes hears at once of all maps"
    alive.close()
    replicator.close()
    bus.close()
    journal.close()


def test_no_log_answers_for_a_map_that_is_not_there(agent: Agent, server: HandServer):
    (reply,) = server.bus.ask(KEYS.log(MapId("r0", 9)), LogRequest(1, 2).encode(), 5)
    assert reply.error.endswith("agent/r0/log/9: no such log")


def test_a_restarted_agent_goes_on_and_prunes_what_all_have(hub: MemoryHub, path: Path, server: HandServer):
    agent = Agent(hub, path)
    agent.replicator.submit([*bodies(1, 1), *bodies(1, 1), *bodies(2, 2)], 0)
    eventually(lambda: len(server.changes) == 3)
    server.acknowledge(agent.log_id, 3)
    assert agent.replicator.wait_acknowledged(30)
    agent.close()
    agent = Agent(hub, path)
    assert agent.replicator.status().newest == 3
    assert agent.replicator.status().unacknowledged == 0
    agent.replicator.submit(bodies(3, 3), 0)
    eventually(lambda: server.heads[-1].newest == 4)
    assert len(server.changes) == 3, "a server shows first which change it has before that"
    assert [sequence for sequence, _ in server.ask(4, 4).changes] == [4]
    agent.replicator.submit(bodies(4, 4), 0)
    eventually(lambda: Mark.decode(server.changes[-1].attachment) == Mark(5, agent.log_id))
    assert [change.sequence for change in agent.journal.changes(MAP, 1, 9)] == [3, 4, 5]
    agent.close()


def test_what_later_changes_undo_leaves_the_disk_while_the_agent_runs(
    agent: Agent, server: HandServer, monkeypatch
):
    monkeypatch.setattr("mapweave.agent.replication.replicator.COMPACTED", 4)
    assert not agent.replicator.shared
    agent.replicator.submit([*bodies(1, 2), *bodies(1, 2), *bodies(9, 9)], 0)
    eventually(lambda: len(server.changes) == 5)
    server.acknowledge(agent.log_id, 3)
    eventually(lambda: agent.replicator.unacknowledged() == 2)
    assert len(agent.journal.changes(MAP, 1, 9)) == 5 and agent.replicator.shared
    server.acknowledge(agent.log_id, 5)
    eventually(lambda: [change.sequence for change in agent.journal.changes(MAP, 1, 9)] == [5])


@given(st.integers(0, 20), st.lists(st.tuples(st.integers(1, 40), st.integers(0, 6))))
def test_ranges_are_the_set_of_their_numbers(last: int, added: list[tuple[int, int]]):
    ranges, numbers = SequenceRanges(last), set(range(last + 1))
    for first, more in added:
        ranges.add(first, first + more)
        numbers |= set(range(first, first + more + 1))
        assert ranges.whole == next(k for k in range(100) if k + 1 not in numbers)
