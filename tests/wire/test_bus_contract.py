"""What every bus must do, run on the in-memory and on the Zenoh implementation."""

import logging
import threading
import time

import pytest

from mapweave.hybridmap.errors import Busy, InvalidValue, MapweaveError
from mapweave.wire.alive_keys import MOST_OF_ONE
from mapweave.wire.bus import Closing, Reply, Request, Sample
from tests.waiting import eventually
from tests.wire.fleets import Fleet, settle, subscribe


def test_a_message_comes_with_key_payload_and_attachment(fleet: Fleet):
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
def test_patterns(fleet: Fleet, pattern: str, keys: set[str]):
    sender, receiver = fleet.join(), fleet.join()
    got = subscribe(receiver, sender, pattern)
    for key in ("a/b/c", "a/x/c", "a/b", "a", "z/c"):
        sender.publish(key, b"")
    ends = subscribe(receiver, sender, "end")
    sender.publish("end", b"")
    # Order is kept within a subscription, not between two: the end may overtake what is wanted.
    eventually(lambda: ends and {sample.key for sample in got} >= keys)
    assert {sample.key for sample in got} == keys
    assert len(got) == len(keys)


def test_a_publisher_receives_its_own_messages(fleet: Fleet):
    bus = fleet.join()
    got = subscribe(bus, bus, "a")
    bus.publish("a", b"1")
    eventually(lambda: [s.payload for s in got] == [b"1"])


@pytest.mark.parametrize("key", ["a/*", "**", "", "a//b", "/a", "a/", "a/@b", "a b", "a/b?c", "ä"])
def test_invalid_keys_are_refused(fleet: Fleet, key: str):
    bus = fleet.join()
    with pytest.raises(InvalidValue):
        bus.publish(key, b"")
    with pytest.raises(InvalidValue):
        bus.announce(key)
    if "*" not in key:
        with pytest.raises(InvalidValue):
            bus.subscribe(key, lambda _: None)


def test_messages_of_one_sender_keep_their_order(fleet: Fleet):
    sender, receiver = fleet.join(), fleet.join()
    got = subscribe(receiver, sender, "n")
    for n in range(200):
        sender.publish("n", n.to_bytes(2, "big"))
    eventually(lambda: len(got) == 200)
    assert [int.from_bytes(s.payload, "big") for s in got] == list(range(200))


def test_a_reply_may_be_enough(fleet: Fleet):
    asker, frozen, quick = fleet.join(), fleet.join(), fleet.join()
    release = threading.Event()
    frozen.serve("who/frozen", lambda request: release.wait(60))
    quick.serve("who/a", lambda request: request.reply(b"a"))
    settle(asker, "who/a")

    quick.serve("who/b", lambda request: request.reply(b"b"))
    settle(asker, "who/b")
    begin = time.monotonic()
    replies = asker.ask("who/*", b"", 40.0, lambda reply: reply.payload == b"b")
    assert replies[-1].payload == b"b"
    assert time.monotonic() - begin < 30, "the frozen one is not waited for"
    release.set()


def test_no_server_to_ask(fleet: Fleet):
    bus = fleet.join()
    begin = time.monotonic()
    assert bus.ask("no/server", b"?", 60.0) == []
    assert time.monotonic() - begin < 20, "an empty answer must not cost the time-out"


def test_one_server_answers(fleet: Fleet):
    asker, server = fleet.join(), fleet.join()
    server.serve("echo", lambda request: request.reply(request.key.encode() + b" " + request.payload))
    settle(asker, "echo")
    assert asker.ask("echo", b"hello", 3.0) == [Reply(payload=b"echo hello")]
    assert asker.ask("echo", b"", 3.0) == [Reply(payload=b"echo ")]


def test_two_servers_answer_and_the_slow_one_does_not_hide_the_quick(fleet: Fleet):
    asker, first, second = fleet.join(), fleet.join(), fleet.join()
    first.serve("server/one/ask", lambda request: request.reply(b"one"))
    second.serve("server/two/ask", lambda request: request.refuse("not today"))
    settle(asker, "server/*/ask", servers=2)
    replies = asker.ask("server/*/ask", b"", 3.0)
    assert sorted(replies, key=lambda r: r.error) == [Reply(payload=b"one"), Reply(error="not today")]


def test_two_servers_under_the_same_key_both_answer(fleet: Fleet):
    asker, first, second = fleet.join(), fleet.join(), fleet.join()
    first.serve("ask", lambda request: request.reply(b"one"))
    second.serve("ask", lambda request: request.reply(b"two"))
    settle(asker, "ask", servers=2)
    assert sorted(reply.payload for reply in asker.ask("ask", b"", 3.0)) == [b"one", b"two"]


def test_a_service_for_a_pattern_gets_the_key(fleet: Fleet):
    asker, server = fleet.join(), fleet.join()
    server.serve("agent/r0/log/*", lambda request: request.reply(request.key.encode()))
    settle(asker, "agent/r0/log/1")
    assert asker.ask("agent/r0/log/7", b"", 3.0) == [Reply(payload=b"agent/r0/log/7")]
    assert asker.ask("agent/r1/log/7", b"", 3.0) == []


def test_a_server_that_never_answers_does_not_hide_the_other(fleet: Fleet):
    asker, first, second = fleet.join(), fleet.join(), fleet.join()
    kept: list[Request] = []
    first.serve("server/one/ask", lambda request: request.reply(b"one"))
    settle(asker, "server/one/ask")
    second.serve("server/two/ask", kept.append)
    eventually(lambda: asker.ask("server/*/ask", b"", 0.3) == [Reply(payload=b"one")] and kept)


def test_handlers_that_raise(fleet: Fleet, caplog):
    asker, server = fleet.join(), fleet.join()

    def expected(request: Request) -> None:
        raise MapweaveError("the reason in words")

    def unexpected(request: Request) -> None:
        raise ZeroDivisionError

    server.serve("expected", expected)
    server.serve("unexpected", unexpected)
    with caplog.at_level(logging.CRITICAL + 1, logger="mapweave.wire.dispatch"):
        settle(asker, "unexpected")
        settle(asker, "expected")
        assert asker.ask("expected", b"", 3.0) == [Reply(error="the reason in words")]
        assert asker.ask("unexpected", b"", 3.0) == [Reply(error="internal error: ZeroDivisionError")]


def test_a_busy_server_gives_a_retry_time(fleet: Fleet):
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


@pytest.mark.parametrize("direct", [False, True])
def test_a_subscriber_that_raises_is_logged_and_goes_on(fleet: Fleet, direct: bool, caplog):
    bus = fleet.join()
    seen: list[bytes] = []

    def handler(sample: Sample) -> None:
        seen.append(sample.payload)
        if sample.payload == b"1":
            raise ValueError("broken handler")

    bus.subscribe("a", handler, direct=direct)
    eventually(lambda: bus.publish("a", b"0") or b"0" in seen)
    with caplog.at_level(logging.ERROR):
        bus.publish("a", b"1")
        bus.publish("a", b"2")
        eventually(lambda: b"2" in seen)
    assert "broken handler" in caplog.text


def test_a_direct_subscriber_gets_all_in_order_until_it_is_closed(fleet: Fleet):
    bus = fleet.join()
    seen: list[bytes] = []
    subscribed = bus.subscribe("a", lambda sample: seen.append(sample.payload), direct=True)
    eventually(lambda: bus.publish("a", b"0") or b"0" in seen)
    for payload in (b"1", b"2", b"3"):
        bus.publish("a", payload)
    eventually(lambda: b"3" in seen)
    assert [payload for payload in seen if payload != b"0"] == [b"1", b"2", b"3"]
    subscribed.close()
    settled = len(seen)
    bus.publish("a", b"4")
    settle_after = subscribe(bus, bus, "b")
    bus.publish("b", b"")
    eventually(lambda: settle_after)
    assert len(seen) == settled


def test_an_answer_may_come_later_from_another_thread_and_counts_once(fleet: Fleet):
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


def test_handlers_run_one_at_a_time_and_may_use_the_bus(fleet: Fleet):
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


def test_tokens_of_one_robot_are_bounded(fleet: Fleet, caplog):
    """Whatever one session declares, others are seen, and so is that a known key of it ends."""
    flooding, honest, watcher = fleet.join(), fleet.join(), fleet.join()
    news: list[tuple[str, bool]] = []
    root = "mapweave/1/f/agent"
    tokens = [flooding.announce(f"{root}/r3/alive/{epoch}") for epoch in range(MOST_OF_ONE + 40)]
    watcher.watch(f"{root}/*/alive/*", lambda key, alive: news.append((key, alive)))
    honest.announce(f"{root}/r1/alive/1")
    eventually(lambda: (f"{root}/r1/alive/1", True) in news)
    eventually(lambda: len(news) == MOST_OF_ONE + 1)
    assert "liveliness tokens left out so far, the last of agent/r3" in caplog.text
    for token in tokens:
        token.close()
    eventually(lambda: sum(not alive for _, alive in news) == MOST_OF_ONE)
    assert {key for key, alive in news if not alive} == {key for key, _ in news} - {f"{root}/r1/alive/1"}
    again = flooding.announce(f"{root}/r3/alive/9999")
    eventually(lambda: news[-1] == (f"{root}/r3/alive/9999", True))
    again.close()


def test_services_at_one_robot_answer_each_for_itself(fleet: Fleet):
    robot, asker = fleet.join(), fleet.join()
    root = "mapweave/1/fleet/agent/r1"

    def serve(what: str) -> Closing:
        return robot.serve(f"{root}/{what}", lambda request: request.reply(f"{what}: {request.key}".encode()))

    def asked(what: str) -> set[str]:
        begin = time.monotonic()
        replies = asker.ask(f"{root}/{what}", b"", 60.0)
        assert time.monotonic() - begin < 30.0, "it waits for an answer that no service gives"
        return {reply.payload.decode().replace(f"{root}/", "") for reply in replies}

    mission, of_anyone, logs = (serve(what) for what in ("mission", "mission/*", "log/*"))
    eventually(lambda: asked("log/3") == {"log/*: log/3"})
    assert asked("mission") == {"mission: mission"}
    assert asked("mission/anna") == {"mission/*: mission/anna"}
    assert {answer.partition(":")[0] for answer in asked("**")} == {"mission", "mission/*", "log/*"}
    assert asked("drive") == set()
    mission.close()
    mission.close()
    eventually(lambda: asked("mission") == set())
    assert asked("mission/anna") == {"mission/*: mission/anna"}
    serve("mission")
    eventually(lambda: asked("mission") == {"mission: mission"})
    of_anyone.close()
    logs.close()
    eventually(lambda: asked("**") == {"mission: mission"})


def test_a_robot_that_serves_nothing_for_a_while_serves_again(fleet: Fleet):
    robot, asker = fleet.join(), fleet.join()
    key = "mapweave/1/fleet/agent/r1/mission"
    for answer in (b"first", b"second"):
        served = robot.serve(key, lambda request, answer=answer: request.reply(answer))
        eventually(lambda answer=answer: [r.payload for r in asker.ask(key, b"", 60.0)] == [answer])
        served.close()
        eventually(lambda: asker.ask(key, b"", 60.0) == [])
