"""What every bus must do, run on the in-memory and on the Zenoh implementation."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

import pytest

from hybridmap.errors import Busy, InvalidValue, MapweaveError, NotConnected
from wire.bus import Bus, Reply, Request, Sample
from wire.bus_settings import BusSettings
from wire.memory import MemoryBus, MemoryHub
from wire.zenoh_bus import ZenohBus


class Fleet(Protocol):
    """Makes buses that can talk to each other, and cuts and mends their connection."""

    def join(self) -> Bus: ...
    def cut(self) -> None: ...
    def mend(self) -> None: ...


class MemoryFleet:
    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.buses: list[MemoryBus] = []

    def join(self) -> MemoryBus:
        self.buses.append(MemoryBus(self.hub))
        return self.buses[-1]

    def cut(self) -> None:
        for bus in self.buses:
            self.hub.cut(bus)

    def mend(self) -> None:
        for bus in self.buses:
            self.hub.restore(bus)

    def close(self) -> None:
        for bus in self.buses:
            bus.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class ZenohFleet:
    def __init__(self) -> None:
        self.endpoints = (f"tcp/127.0.0.1:{free_port()}",)
        self.router = self.open_router()
        self.buses: list[ZenohBus] = []

    def open_router(self) -> ZenohBus:
        return ZenohBus(BusSettings(mode="router", listen=self.endpoints))

    def join(self) -> ZenohBus:
        bus = ZenohBus(BusSettings(endpoints=self.endpoints))
        self.buses.append(bus)
        assert bus.wait_connected(5)
        return bus

    def cut(self) -> None:
        self.router.close()

    def mend(self) -> None:
        self.router = self.open_router()

    def close(self) -> None:
        for bus in self.buses:
            bus.close()
        self.router.close()


@pytest.fixture(params=[MemoryFleet, ZenohFleet])
def fleet(request: pytest.FixtureRequest) -> Iterator[Fleet]:
    fleet = request.param()
    yield fleet
    fleet.close()


def eventually(condition: Callable[[], object], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.005)


def settle(asker: Bus, key: str, servers: int = 1) -> list[Reply]:
    """Ask until so many servers are seen: a declaration needs a moment to get about."""
    replies: list[Reply] = []

    def seen() -> bool:
        replies[:] = asker.ask(key, b"ping", 2.0)
        return len(replies) >= servers

    eventually(seen)
    return replies


def subscribe(bus: Bus, others: Bus, pattern: str) -> list[Sample]:
    """Subscribe and wait until it is known to the other side."""
    got: list[Sample] = []
    probes: list[Sample] = []
    bus.subscribe(pattern, got.append)
    bus.subscribe("probe/**", probes.append)

    def arrives() -> bool:
        others.publish("probe/x", b"")
        return bool(probes)

    eventually(arrives)
    return got


def test_a_message_comes_with_key_payload_and_attachment(fleet: Fleet) -> None:
    sender, receiver = fleet.join(), fleet.join()
    got = subscribe(receiver, sender, "a/b")
    sender.publish("a/b", b"\x00payload", b"\xffattachment")
    sender.publish("a/b", b"")
    eventually(lambda: len(got) == 2)
    assert got == [Sample("a/b", b"\x00payload", b"\xffattachment"), Sample("a/b", b"", b"")]


@pytest.mark.parametrize(
    ("pattern", "keys"),
    [
        ("a/*/c", {"a/b/c", "a/x/c"}),
        ("a/**", {"a/b/c", "a/x/c", "a/b", "a"}),
        ("**/c", {"a/b/c", "a/x/c", "z/c"}),
        ("a/b", {"a/b"}),
    ],
)
def test_patterns(fleet: Fleet, pattern: str, keys: set[str]) -> None:
    sender, receiver = fleet.join(), fleet.join()
    got = subscribe(receiver, sender, pattern)
    for key in ("a/b/c", "a/x/c", "a/b", "a", "z/c"):
        sender.publish(key, b"")
    ends = subscribe(receiver, sender, "end")
    sender.publish("end", b"")
    eventually(lambda: ends)
    assert {sample.key for sample in got} == keys
    assert len(got) == len(keys)


def test_one_hears_oneself(fleet: Fleet) -> None:
    bus = fleet.join()
    got = subscribe(bus, bus, "a")
    bus.publish("a", b"1")
    eventually(lambda: [s.payload for s in got] == [b"1"])


@pytest.mark.parametrize("key", ["a/*", "**", "", "a//b", "/a", "a/", "a/@b", "a b", "a/b?c", "ä"])
def test_what_is_no_key_is_refused(fleet: Fleet, key: str) -> None:
    bus = fleet.join()
    with pytest.raises(InvalidValue):
        bus.publish(key, b"")
    with pytest.raises(InvalidValue):
        bus.announce(key)
    if "*" not in key:
        with pytest.raises(InvalidValue):
            bus.subscribe(key, lambda _: None)


def test_messages_of_one_sender_keep_their_order(fleet: Fleet) -> None:
    sender, receiver = fleet.join(), fleet.join()
    got = subscribe(receiver, sender, "n")
    for n in range(200):
        sender.publish("n", n.to_bytes(2, "big"))
    eventually(lambda: len(got) == 200)
    assert [int.from_bytes(s.payload, "big") for s in got] == list(range(200))


def test_nobody_to_ask(fleet: Fleet) -> None:
    bus = fleet.join()
    begin = time.monotonic()
    assert bus.ask("nobody/here", b"?", 3.0) == []
    assert time.monotonic() - begin < 1.0, "an empty answer must not cost the time-out"


def test_one_server_answers(fleet: Fleet) -> None:
    asker, server = fleet.join(), fleet.join()
    server.serve("echo", lambda request: request.reply(request.key.encode() + b" " + request.payload))
    settle(asker, "echo")
    assert asker.ask("echo", b"hello", 3.0) == [Reply(payload=b"echo hello")]
    assert asker.ask("echo", b"", 3.0) == [Reply(payload=b"echo ")]


def test_two_servers_answer_and_the_slow_one_does_not_hide_the_quick(fleet: Fleet) -> None:
    asker, one, two = fleet.join(), fleet.join(), fleet.join()
    one.serve("server/one/ask", lambda request: request.reply(b"one"))
    two.serve("server/two/ask", lambda request: request.refuse("not today"))
    settle(asker, "server/*/ask", servers=2)
    replies = asker.ask("server/*/ask", b"", 3.0)
    assert sorted(replies, key=lambda r: r.error) == [Reply(payload=b"one"), Reply(error="not today")]


def test_two_servers_under_the_same_key_both_answer(fleet: Fleet) -> None:
    asker, one, two = fleet.join(), fleet.join(), fleet.join()
    one.serve("ask", lambda request: request.reply(b"one"))
    two.serve("ask", lambda request: request.reply(b"two"))
    settle(asker, "ask", servers=2)
    assert sorted(reply.payload for reply in asker.ask("ask", b"", 3.0)) == [b"one", b"two"]


def test_one_service_for_a_pattern_knows_which_key_was_asked(fleet: Fleet) -> None:
    asker, server = fleet.join(), fleet.join()
    server.serve("agent/r0/log/*", lambda request: request.reply(request.key.encode()))
    settle(asker, "agent/r0/log/1")
    assert asker.ask("agent/r0/log/7", b"", 3.0) == [Reply(payload=b"agent/r0/log/7")]
    assert asker.ask("agent/r1/log/7", b"", 3.0) == []


def test_a_server_that_never_answers_does_not_hide_the_other(fleet: Fleet) -> None:
    asker, one, two = fleet.join(), fleet.join(), fleet.join()
    kept: list[Request] = []
    one.serve("server/one/ask", lambda request: request.reply(b"one"))
    settle(asker, "server/one/ask")
    two.serve("server/two/ask", kept.append)
    eventually(lambda: asker.ask("server/*/ask", b"", 0.3) == [Reply(payload=b"one")] and kept)


def test_handlers_that_raise(fleet: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    asker, server = fleet.join(), fleet.join()

    def expected(request: Request) -> None:
        raise MapweaveError("the reason in words")

    def unexpected(request: Request) -> None:
        raise ZeroDivisionError

    server.serve("expected", expected)
    server.serve("unexpected", unexpected)
    with caplog.at_level(logging.CRITICAL + 1, logger="wire.dispatch"):
        settle(asker, "unexpected")
        settle(asker, "expected")
        assert asker.ask("expected", b"", 3.0) == [Reply(error="the reason in words")]
        assert asker.ask("unexpected", b"", 3.0) == [Reply(error="internal error: ZeroDivisionError")]


def test_a_busy_server_says_when_to_ask_again(fleet: Fleet) -> None:
    asker, server = fleet.join(), fleet.join()

    def raises(request: Request) -> None:
        raise Busy(0.84)

    server.serve("raises", raises)
    server.serve("refuses", lambda request: request.refuse("busy, retry after 0.8 s", 0.84))
    for key in ("raises", "refuses"):
        settle(asker, key)
        (reply,) = asker.ask(key, b"", 3.0)
        assert reply.error == "busy, retry after 0.8 s"
        assert reply.retry_after == pytest.approx(0.84)
        assert not reply.payload


def test_a_subscriber_that_raises_is_logged_and_goes_on(
    fleet: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    bus = fleet.join()
    seen: list[bytes] = []

    def handler(sample: Sample) -> None:
        seen.append(sample.payload)
        if sample.payload == b"1":
            raise ValueError("broken handler")

    bus.subscribe("a", handler)
    eventually(lambda: bus.publish("a", b"0") or b"0" in seen)
    with caplog.at_level(logging.ERROR):
        bus.publish("a", b"1")
        bus.publish("a", b"2")
        eventually(lambda: b"2" in seen)
    assert "broken handler" in caplog.text


def test_an_answer_may_come_later_from_another_thread_and_counts_once(fleet: Fleet) -> None:
    asker, server = fleet.join(), fleet.join()

    def later(request: Request) -> None:
        def answer() -> None:
            time.sleep(0.05)
            request.reply(b"later")
            request.reply(b"twice")
            request.refuse("thrice")

        threading.Thread(target=answer).start()

    server.serve("slow", later)
    settle(asker, "slow")
    assert asker.ask("slow", b"", 3.0) == [Reply(payload=b"later")]


def test_handlers_run_one_at_a_time_and_may_use_the_bus(fleet: Fleet) -> None:
    bus = fleet.join()
    running: list[str] = []
    overlaps: list[str] = []
    echoed: list[Sample] = []

    def handler(sample: Sample) -> None:
        if running:
            overlaps.append(sample.key)
        running.append(sample.key)
        time.sleep(0.01)
        if sample.payload == b"go":
            bus.subscribe("echo", echoed.append)
            bus.publish("echo", b"")
        running.pop()

    bus.subscribe("one", handler)
    bus.subscribe("two", handler)
    eventually(lambda: bus.publish("one", b"go") or bus.publish("two", b"") or echoed)
    assert not overlaps


def test_who_is_alive_before_and_after(fleet: Fleet) -> None:
    watcher, others = fleet.join(), fleet.join()
    others.announce("agent/r0/alive")
    news: list[tuple[str, bool]] = []
    watching = watcher.watch("agent/*/alive", lambda key, alive: news.append((key, alive)))
    eventually(lambda: news == [("agent/r0/alive", True)])
    later = others.announce("agent/r1/alive")
    others.announce("server/s/alive")
    eventually(lambda: len(news) == 2)
    later.close()
    later.close()
    eventually(lambda: len(news) == 3)
    others.close()
    eventually(lambda: len(news) == 4)
    assert news[1:] == [("agent/r1/alive", True), ("agent/r1/alive", False), ("agent/r0/alive", False)]
    watching.close()


def test_what_is_closed_is_not_called_any_more(fleet: Fleet) -> None:
    asker, server = fleet.join(), fleet.join()
    got: list[Sample] = []
    subscription = server.subscribe("a", got.append)
    service = server.serve("q", lambda request: request.reply(b"yes"))
    settle(asker, "q")
    subscription.close()
    subscription.close()
    service.close()
    eventually(lambda: asker.ask("q", b"", 1.0) == [])
    ends = subscribe(server, asker, "end")
    asker.publish("a", b"")
    asker.publish("end", b"")
    eventually(lambda: ends)
    assert not got


def test_closing_twice_and_using_what_is_closed(fleet: Fleet) -> None:
    bus = fleet.join()
    closing = bus.subscribe("a", lambda _: None)
    bus.close()
    bus.close()
    closing.close()
    assert not bus.connected()
    bus.publish("a", b"")
    assert bus.ask("a", b"", 1.0) == []
    with pytest.raises(NotConnected):
        bus.subscribe("a", lambda _: None)


def test_a_question_whose_server_closes_does_not_wait_for_the_time_out(fleet: Fleet) -> None:
    asker, server = fleet.join(), fleet.join()
    kept: list[Request] = []
    answer: list[list[Reply]] = []
    server.serve("q", kept.append)
    eventually(lambda: asker.ask("q", b"", 0.05) or kept)
    held = len(kept)
    thread = threading.Thread(target=lambda: answer.append(asker.ask("q", b"", 20.0)))
    thread.start()
    eventually(lambda: len(kept) > held)
    server.close()
    thread.join(timeout=5)
    assert answer == [[]]


def test_closing_a_bus_ends_its_own_questions(fleet: Fleet) -> None:
    asker, server = fleet.join(), fleet.join()
    kept: list[Request] = []
    answer: list[list[Reply]] = []
    server.serve("q", kept.append)
    eventually(lambda: asker.ask("q", b"", 0.05) or kept)
    held = len(kept)
    thread = threading.Thread(target=lambda: answer.append(asker.ask("q", b"", 20.0)))
    thread.start()
    eventually(lambda: len(kept) > held)
    asker.close()
    thread.join(timeout=5)
    assert answer == [[]]


def test_without_a_connection_nothing_blocks_and_all_comes_back(fleet: Fleet) -> None:
    one, two = fleet.join(), fleet.join()
    got = subscribe(two, one, "a")
    two.serve("q", lambda request: request.reply(b"yes"))
    settle(one, "q")
    news: list[bool] = []
    two.announce("token")
    one.watch("token", lambda _, alive: news.append(alive))
    eventually(lambda: news == [True])

    fleet.cut()
    eventually(lambda: not one.connected() and not two.connected())
    begin = time.monotonic()
    for _ in range(1000):
        one.publish("a", b"into the void")
    assert one.ask("q", b"", 2.0) == []
    assert time.monotonic() - begin < 1.0
    eventually(lambda: news == [True, False])

    fleet.mend()
    eventually(lambda: one.connected() and two.connected())
    eventually(lambda: one.ask("q", b"", 1.0) == [Reply(payload=b"yes")])
    eventually(lambda: one.publish("a", b"back") or b"back" in [s.payload for s in got])
    eventually(lambda: news == [True, False, True])
    assert b"into the void" not in [s.payload for s in got]
