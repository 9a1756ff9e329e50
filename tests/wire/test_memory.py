"""The in-memory hub's faults, and the dispatcher's bounded queue."""

import logging
import threading

import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidMessage, SettingsError
from mapweave.hybridmap.ids import MapId
from mapweave.wire import dispatch
from mapweave.wire.bus import Reply, Request, Sample
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.dispatch import EVERY, Dispatcher, Failures
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub, MessageFaults
from tests.waiting import eventually


def run(faults: MessageFaults, count: int = 300, seed: int = 1) -> list[int]:
    """The numbers that arrive out of 0 .. count, and those that calming the hub sets free."""
    hub = MemoryHub()
    sender, receiver = MemoryBus(hub), MemoryBus(hub)
    got: list[int] = []
    receiver.subscribe("n", lambda sample: got.append(int(sample.payload)))
    hub.disturb(faults, np.random.default_rng(seed))
    for n in range(count):
        sender.publish("n", str(n).encode())
    hub.calm()
    sender.publish("n", b"-1")
    eventually(lambda: -1 in got)
    sender.close()
    receiver.close()
    return got[:-1]


def test_without_faults_all_arrives_in_order():
    assert run(MessageFaults()) == list(range(300))


def test_one_bus_can_be_disturbed_alone(hub: MemoryHub):
    bad, good, receiver = MemoryBus(hub), MemoryBus(hub), MemoryBus(hub)
    got: list[bytes] = []
    receiver.subscribe("n", lambda sample: got.append(sample.payload))
    hub.disturb(MessageFaults(drop=1.0), np.random.default_rng(1), bad)
    for _ in range(20):
        bad.publish("n", b"bad")
        good.publish("n", b"good")
    hub.calm(bad)
    bad.publish("n", b"end")
    eventually(lambda: b"end" in got)
    assert got == [b"good"] * 20 + [b"end"]


def test_dropped_messages_are_gone_and_the_others_in_order():
    got = run(MessageFaults(drop=0.3))
    assert got == sorted(set(got))
    assert 150 < len(got) < 270


def test_doubled_messages_come_twice():
    got = run(MessageFaults(double=0.3))
    assert got == sorted(got)
    assert set(got) == set(range(300))
    assert 330 < len(got) < 450


def test_delayed_messages_come_later_but_come():
    got = run(MessageFaults(delay=0.3, longest_delay=5))
    assert sorted(got) == list(range(300))
    assert got != sorted(got)
    assert max(abs(place - n) for place, n in enumerate(got)) <= 10


def test_the_same_seed_makes_the_same_faults():
    faults = MessageFaults(0.2, 0.2, 0.2)
    assert run(faults, seed=3) == run(faults, seed=3)
    assert run(faults, seed=3) != run(faults, seed=4)


def test_a_cut_bus_is_dead_to_the_others_and_they_to_it(hub: MemoryHub):
    first, second = MemoryBus(hub), MemoryBus(hub)
    news: list[tuple[str, str, bool]] = []
    first.announce("one")
    second.announce("two")
    first.watch("*", lambda key, alive: news.append(("one sees", key, alive)))
    second.watch("*", lambda key, alive: news.append(("two sees", key, alive)))
    eventually(lambda: len(news) == 4)
    hub.cut(second)
    eventually(lambda: len(news) == 7)
    assert ("one sees", "two", False) in news
    assert ("two sees", "one", False) in news
    hub.restore(second)
    eventually(lambda: len(news) == 10)


def test_an_answer_from_a_bus_that_was_cut_meanwhile_is_lost(hub: MemoryHub):
    asker, server = MemoryBus(hub), MemoryBus(hub)
    kept: list[Request] = []
    server.serve("q", kept.append)
    answers: list[list[Reply]] = []
    thread = threading.Thread(target=lambda: answers.append(asker.ask("q", b"", 5)))
    thread.start()
    eventually(lambda: kept)
    hub.cut(server)
    kept[0].reply(b"into the void")
    thread.join()
    assert answers == [[]]


class _Question:
    """A request that remembers what became of it."""

    key, payload = "q", b""

    def __init__(self) -> None:
        self.refusal = ""
        self.retry_after = 0.0

    def reply(self, payload: bytes) -> None:
        raise AssertionError("no server replies here")

    def refuse(self, reason: str, retry_after: float = 0.0) -> None:
        self.refusal, self.retry_after = reason, retry_after


def test_a_full_queue_counts_messages_refuses_questions_and_keeps_presence(caplog):
    dispatcher = Dispatcher("test", limit=2)
    release, started = threading.Event(), threading.Event()
    seen: list[str] = []

    def slow(_: Sample) -> None:
        started.set()
        release.wait(5)

    dispatcher.message(slow, Sample("slow", b""), lambda: True)
    started.wait(5)
    with caplog.at_level(logging.WARNING):
        for n in range(5):
            dispatcher.message(lambda s: seen.append(s.key), Sample(f"m{n}", b""), lambda: True)
        question = _Question()
        dispatcher.question(lambda _: None, question, lambda: True)
    dispatcher.presence(lambda: seen.append("token True"), "token")
    assert (question.refusal, question.retry_after) == ("busy, retry after 1.0 s", 1.0)
    assert (dispatcher.lost, dispatcher.refused) == (3, 1)
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 3, (
        "at 1 and 2 lost, and 1 refused"
    )
    release.set()
    eventually(lambda: len(seen) == 3)
    assert seen == ["m0", "m1", "token True"]
    dispatcher.close()


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"mode": "peer"}, "use client or router"),
        ({"endpoints": ()}, "at least one endpoint"),
        ({"endpoints": ("localhost:7447",)}, "endpoints look like"),
        ({"mode": "router", "listen": ("tcp/x",)}, "endpoints look like"),
    ],
)
def test_settings_that_cannot_work(settings: dict[str, object], reason: str):
    with pytest.raises(SettingsError, match=reason):
        BusSettings(**settings)  # type: ignore[arg-type]


def test_what_a_robot_sends_wrong_fills_no_log():
    now = [1000.0]
    counted = Failures(lambda: now[0])
    keys = Keys("demo")
    assert counted.count(keys.agent_status("r0")) == ""
    assert [counted.count(keys.agent_alive(MapId("r0", k))) for k in range(500)] == [None] * 500
    assert counted.count(keys.agent_status("r1")) == "", "each robot is counted apart"
    now[0] += EVERY
    assert counted.count(keys.agent_status("r0")) == " (500 more of r0 within 60 s)"
    assert counted.count(keys.agent_status("r1")) == ""
    assert [counted.count(keys.server_status("s0")) for _ in range(3)] == [""] * 3, "a defect of its own"


def test_names_of_robots_whose_messages_are_wrong_fill_no_memory(monkeypatch):
    monkeypatch.setattr(dispatch, "MOST_ROBOTS", 10)
    failures = Failures(clock=lambda: 0.0)
    for number in range(100):
        assert failures.count_of(f"x{number}") == ""
    assert len(failures._since) == 10
    assert failures.count_of("x99") is None


def test_a_flood_of_wrong_messages_is_one_line(hub: MemoryHub, caplog):
    keys = Keys("demo")
    robot, server = MemoryBus(hub), MemoryBus(hub)
    heard: list[int] = []

    def handler(sample: Sample) -> None:
        heard.append(len(sample.payload))
        raise InvalidMessage("agent status: no map of fields")

    server.subscribe(keys.agent_statuses(), handler)
    with caplog.at_level(logging.WARNING):
        for _ in range(1000):
            robot.publish(keys.agent_status("r17"), b"x")
        eventually(lambda: len(heard) == 1000)
    assert len([record for record in caplog.records if "no map of fields" in record.getMessage()]) == 1
