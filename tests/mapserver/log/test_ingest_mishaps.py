"""The ingest against what goes wrong: damage, refusals, silence, full disks, strangers."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from mapweave.hybridmap.change import Change
from mapweave.hybridmap.errors import InvalidFile, MapweaveError
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.puller import MOST_REPLIES
from mapweave.mapserver.log.store import LogChanges
from mapweave.mapserver.quotas import BURST, Quotas, QuotaSettings
from mapweave.wire.bus import Reply, Request, never
from mapweave.wire.codec import MAX_CHANGE_BYTES
from mapweave.wire.log_messages import LogAnswer, LogRequest, Mark, Refusal
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.mapserver.played import KEYS, LOG_ID, MAP, QUICK, HandAgent, Server, message
from tests.waiting import eventually


def test_a_change_damaged_on_the_way_is_pulled(server: Server, agent: HandAgent):
    agent.serve(2)
    agent.publish(1, b"\xc1" * 50)
    agent.publish(2)
    eventually(lambda: server.sequences == [1, 2])
    assert server.ingest.counters().damaged == 1
    assert server.store.refused() == 0


def test_a_change_bad_in_the_log_is_refused_once_and_the_log_goes_on(server: Server, agent: HandAgent):
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


def test_a_change_that_cannot_even_be_carried_is_found_and_refused(server: Server, agent: HandAgent):
    """It spoils every answer that it is in, so the pieces get smaller until it is alone."""
    agent.serve(20)
    agent.log[7] = b"x" * (MAX_CHANGE_BYTES + 1)
    agent.beacon(20)
    eventually(lambda: server.sequences == [s for s in range(1, 21) if s != 7])
    assert [refusal.sequence for refusal in server.store.refusals(MAP)] == [7]


def test_a_question_that_fails_unforeseen_is_asked_again(server: Server, agent: HandAgent, monkeypatch):
    """The robot counted as asked for ever."""
    failures = [MemoryError(), RuntimeError("unforeseen")]
    real = MemoryBus.ask

    def ask(bus: MemoryBus, key: str, *rest: Any) -> list[Reply]:
        if failures and key == KEYS.log(MAP):
            raise failures.pop()
        return real(bus, key, *rest)

    monkeypatch.setattr(MemoryBus, "ask", ask)
    agent.serve(3)
    agent.beacon(3)
    eventually(lambda: server.sequences == [1, 2, 3])
    assert not failures


def test_answers_that_are_none_are_asked_again(server: Server, agent: HandAgent):
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


@pytest.mark.parametrize("answer", [b"garbage", "no"])
def test_answers_that_are_none_fill_neither_memory_nor_log(
    server: Server, agent: HandAgent, monkeypatch, caplog,
    answer: bytes | str
):  # fmt: skip
    """A robot over TLS wrote ten lines a second, by as many answers to each question as it liked."""
    real, taken = MemoryBus.ask, list[int]()

    def many(
        bus: MemoryBus, key: str, payload: bytes, timeout: float, enough: Callable[[Reply], bool] = never
    ) -> list[Reply]:
        replies = real(bus, key, payload, timeout)
        if key != KEYS.log(MAP):
            return replies
        taken.append(next((k for k in range(1, 100) if enough(replies[0])), 100))
        return replies * taken[-1]

    monkeypatch.setattr(MemoryBus, "ask", many)
    with caplog.at_level(logging.INFO):
        agent.serve(5, lambda asked: answer)
        eventually(lambda: agent.beacon(5) or len(taken) >= 5)
    assert set(taken) == {MOST_REPLIES}
    assert len([one for one in caplog.records if "r0.3 from" in one.getMessage()]) <= 1


def test_an_agent_that_cannot_be_asked_is_asked_less_and_less(server: Server, agent: HandAgent):
    began = time.monotonic()
    agent.beacon(5)
    eventually(lambda: server.ingest.counters().pulls >= 5)
    assert time.monotonic() - began >= 0.2, "at 0, 0.02, 0.06, 0.14, 0.24 ... s"
    agent.serve(5)
    eventually(lambda: server.sequences == [1, 2, 3, 4, 5])


def test_a_silent_agent_does_not_hold_up_another(
    hub: MemoryHub, agent: HandAgent, started: Callable[..., Server]
):
    # Its silence is longer than the test waits for the other.
    server = started(settings=replace(QUICK, ask_timeout=600.0))
    kept: list[Request] = []
    agent.bus.serve(KEYS.log(MAP), kept.append)
    agent.beacon(5)
    eventually(lambda: kept)
    other = HandAgent(hub, MapId("r1", 1))
    other.serve(3)
    other.beacon(3)
    eventually(lambda: server.store.watermark(other.map) == 3, seconds=1)
    kept[0].refuse("at last")


def test_another_log_under_the_same_name_is_refused(hub: MemoryHub, server: Server, agent: HandAgent):
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


def test_messages_that_are_none_are_counted_and_change_nothing(server: Server, agent: HandAgent):
    agent.bus.publish(KEYS.change(MAP), message(1), b"short")
    agent.bus.publish(KEYS.change(MAP), message(1))
    agent.bus.publish(f"{KEYS.root}/agent/R0/change/3", message(1), Mark(1, 1).encode())
    agent.bus.publish(KEYS.head(MAP), b"garbage")
    agent.publish(1, b"x" * 200_000)
    eventually(lambda: server.ingest.counters().damaged == 5)
    agent.publish(1)
    eventually(lambda: server.sequences == [1])


def test_a_consumer_that_fails_on_a_change_gets_the_next(server: Server, agent: HandAgent, caplog):
    def choke(change: Change) -> None:
        server.seen.append(change)
        if change.sequence == 1:
            raise ZeroDivisionError("choked")

    server.on_change = choke
    with caplog.at_level(logging.ERROR):
        agent.publish_each(1, 2)
        eventually(lambda: server.sequences == [1, 2])
    assert "choked" in caplog.text


def test_a_disk_that_is_full_for_long_takes_nothing_from_what_a_robot_may_send(
    started: Callable[..., Server], agent: HandAgent, monkeypatch
):
    # The clock stands: 1000 changes may come in all, those that are pulled and not stored included.
    quotas = Quotas(QuotaSettings(changes=1000.0 / BURST), lambda: 0.0)
    server = started(quotas=quotas)
    agent.serve(600)
    with monkeypatch.context() as patched:
        patched.setattr(server.store, "apply_all", lambda runs: [InvalidFile("full") for _ in runs])
        agent.beacon(600)
        eventually(lambda: server.ingest.counters().failures >= 20)
    eventually(lambda: server.store.watermark(MAP) == 600)
    assert quotas.totals() == {}


def test_a_disk_that_is_full_for_a_while(server: Server, agent: HandAgent, monkeypatch, caplog):
    agent.serve(3)

    def full(runs: list[LogChanges]) -> list[MapweaveError]:
        return [InvalidFile("s0.sqlite: map store cannot be used (database or disk is full)") for _ in runs]

    with monkeypatch.context() as patched, caplog.at_level(logging.ERROR):
        patched.setattr(server.store, "apply_all", full)
        agent.publish_each(1, 2, 3)
        eventually(lambda: server.ingest.counters().failures >= 3)
        assert "disk is full" in server.ingest.failure
    assert len(caplog.records) == 1, "one line, not one for each attempt"
    assert not agent.acks
    eventually(lambda: server.sequences == [1, 2, 3])
    assert server.ingest.failure == ""
