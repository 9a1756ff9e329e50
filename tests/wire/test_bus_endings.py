"""What every bus must do when a peer closes, dies or is cut off, on both implementations."""

import threading
import time

import pytest

from mapweave.hybridmap.errors import NotConnected
from mapweave.wire.bus import Reply, Request, Sample
from tests.waiting import eventually
from tests.wire.fleets import Fleet, settle, subscribe


def test_liveliness_before_and_after(fleet: Fleet):
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


def test_closed_handlers_are_not_called(fleet: Fleet):
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


def test_closing_twice_and_use_after_close(fleet: Fleet):
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


@pytest.mark.parametrize("who", ["the asker", "the server"])
def test_a_question_during_closing_does_not_wait_for_the_timeout(fleet: Fleet, who: str):
    asker, server = fleet.join(), fleet.join()
    kept: list[Request] = []
    answer: list[list[Reply]] = []
    server.serve("q", kept.append)
    eventually(lambda: asker.ask("q", b"", 0.05) or kept)
    held = len(kept)
    thread = threading.Thread(target=lambda: answer.append(asker.ask("q", b"", 60.0)))
    thread.start()
    eventually(lambda: len(kept) > held)
    (asker if who == "the asker" else server).close()
    thread.join(timeout=30)
    assert answer == [[]]


def test_without_a_connection_nothing_blocks_and_all_comes_back(fleet: Fleet):
    first, second = fleet.join(), fleet.join()
    got = subscribe(second, first, "a")
    second.serve("q", lambda request: request.reply(b"yes"))
    settle(first, "q")
    news: list[bool] = []
    second.announce("token")
    first.watch("token", lambda _, alive: news.append(alive))
    eventually(lambda: news == [True])

    fleet.cut()
    eventually(lambda: not first.connected() and not second.connected())
    begin = time.monotonic()
    for _ in range(1000):
        first.publish("a", b"into the void")
    assert first.ask("q", b"", 60.0) == []
    assert time.monotonic() - begin < 20
    eventually(lambda: news == [True, False])

    fleet.mend()
    eventually(lambda: first.connected() and second.connected())
    eventually(lambda: first.ask("q", b"", 1.0) == [Reply(payload=b"yes")])
    eventually(lambda: first.publish("a", b"back") or b"back" in [s.payload for s in got])
    eventually(lambda: news == [True, False, True])
    assert b"into the void" not in [s.payload for s in got]
