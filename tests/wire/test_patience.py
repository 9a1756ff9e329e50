"""Asking servers that are busy."""

import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from unittest.mock import ANY

import pytest

from mapweave.wire.bus import Reply, Request, never
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.patience import MOST_BYTES, MOST_OPEN, MOST_REPLIES, BusyServers, ask_patiently


def busy_twice(asked: list[float], answer: bytes) -> Callable[[Request], None]:
    """A server that answers the third question; `asked` has when each came, s."""

    def handle(request: Request) -> None:
        asked.append(time.monotonic())
        if len(asked) < 3:
            request.refuse("busy", 0.1)
        else:
            request.reply(answer)

    return handle


def test_a_busy_server_is_asked_again_at_its_time(hub: MemoryHub):
    server, person = MemoryBus(hub), MemoryBus(hub)
    asked: list[float] = []
    server.serve("why", busy_twice(asked, b"because"))
    assert ask_patiently(person, "why", b"", 20.0) == [Reply(b"because")]
    assert len(asked) == 3 and asked[1] - asked[0] >= 0.1
    # Not beyond the time that the person gives.
    asked.clear()
    (reply,) = ask_patiently(person, "why", b"", 0.05)
    assert reply.error == "busy" and len(asked) == 1


@pytest.fixture
def silent(hub: MemoryHub) -> Iterator[MemoryBus]:
    """A server that takes questions and answers none, as one that is stopped."""
    bus, end = MemoryBus(hub), threading.Event()

    def hold(request: Request) -> None:
        end.wait(30.0)

    bus.serve("where", hold)
    yield bus
    end.set()


def answered(reply: Reply) -> bool:
    """Whether it is an answer, no refusal."""
    return bool(reply.payload)


def test_a_busy_server_is_asked_again_while_another_says_nothing(hub: MemoryHub, silent: MemoryBus):
    server, robot = MemoryBus(hub), MemoryBus(hub)
    asked: list[float] = []
    server.serve("where", busy_twice(asked, b"here"))
    began = time.monotonic()
    replies = BusyServers(robot, "where", b"", answered).ask(20.0)
    assert time.monotonic() - began < 5.0
    assert [one.error or one.payload for one in replies] == ["busy", "busy", b"here"]
    assert len(asked) == 3 and all(b - a >= 0.1 for a, b in pairwise(asked))


def test_a_busy_server_alone_is_not_asked_again(hub: MemoryHub):
    """The robot goes on, and asks again at the time that the server names."""
    server, robot = MemoryBus(hub), MemoryBus(hub)
    asked: list[Request] = []

    def refuse(request: Request) -> None:
        asked.append(request)
        request.refuse("busy", 0.01)

    server.serve("where", refuse)
    assert BusyServers(robot, "where", b"", answered).ask(20.0) == [Reply(error="busy", retry_after=ANY)]
    assert len(asked) == 1


def test_a_slow_answer_counts_after_the_busy_one_was_asked_again(hub: MemoryHub):
    slow, busy, robot = MemoryBus(hub), MemoryBus(hub), MemoryBus(hub)
    first = threading.Event()

    def answer(request: Request) -> None:
        if first.is_set():
            request.refuse("your last question is open", 5.0)
            return
        first.set()
        threading.Timer(0.5, request.reply, (b"here",)).start()

    slow.serve("where", answer)
    busy.serve("where", lambda request: request.refuse("busy", 0.1))
    began = time.monotonic()
    assert Reply(b"here") in BusyServers(robot, "where", b"", answered).ask(20.0)
    assert time.monotonic() - began < 5.0


@pytest.mark.parametrize("timeout", [0.05, 0.3])
def test_the_wait_ends_with_its_time(hub: MemoryHub, silent: MemoryBus, timeout: float):
    server, robot = MemoryBus(hub), MemoryBus(hub)
    server.serve("where", lambda request: request.refuse("busy", 0.1))
    began = time.monotonic()
    replies = BusyServers(robot, "where", b"", answered).ask(timeout)
    assert timeout <= time.monotonic() - began < timeout + 2.0
    assert replies and all(one.error == "busy" for one in replies)


def test_a_server_that_is_always_busy_for_a_moment_is_asked_seldom(hub: MemoryHub, silent: MemoryBus):
    """One that lied so was asked 370 times a second, by up to 380 threads."""
    liar, robot = MemoryBus(hub), MemoryBus(hub)
    asked: list[str] = []

    def refuse(request: Request) -> None:
        asked.append(request.key)
        request.refuse("busy", 1e-3)

    liar.serve("where", refuse)
    BusyServers(robot, "where", b"", answered).ask(1.0)
    assert 2 <= len(asked) <= MOST_OPEN


class Endless(MemoryBus):
    """Its question is replied to without end."""

    def __init__(self, hub: MemoryHub, payload: bytes) -> None:
        super().__init__(hub)
        self._payload = payload

    def ask(
        self, key: str, payload: bytes, timeout: float, enough: Callable[[Reply], bool] = never
    ) -> list[Reply]:
        for count in range(1, 10**6):
            if enough(Reply(self._payload)):
                return [Reply(self._payload)] * count
        raise AssertionError("without end")


@pytest.mark.parametrize(("size", "most"), [(1, MOST_REPLIES), (2**20, MOST_BYTES // 2**20)])
def test_replies_without_end_are_enough_at_some_time(hub: MemoryHub, size: int, most: int):
    """A robot's memory grew by 1 GB within its patience."""
    robot = Endless(hub, bytes(size))
    assert len(BusyServers(robot, "where", b"", lambda reply: False).ask(5.0)) == most
