"""A router that keeps a connection and has forgotten the client behind it, as Zenoh's does after a storm."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest
import zenoh

from mapweave.wire import zenoh_bus
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from tests.waiting import eventually, free_port

KEEP_ALIVE = b"\x01\x00\x04"
"""A batch of one byte, the message that keeps a transport alive: Zenoh sends it where it has nothing else."""


class ForgetfulLink:
    """Passes TCP on to a router, batch by batch; forgotten connections are kept alive, and no more."""

    def __init__(self, to: int) -> None:
        self._to = to
        self._forgets = threading.Event()
        self.accepted = 0
        self._sockets: list[socket.socket] = []
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def forget(self) -> None:
        """All who are connected now."""
        self._forgets.set()
        self._forgets = threading.Event()

    def close(self) -> None:
        for one in (self._server, *self._sockets):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._server.accept()
                router = socket.create_connection(("127.0.0.1", self._to))
                self.accepted += 1
                self._sockets += [client, router]
                for a, b in ((client, router), (router, client)):
                    threading.Thread(target=self._pass, args=(a, b, self._forgets), daemon=True).start()

    def _pass(self, a: socket.socket, b: socket.socket, forgotten: threading.Event) -> None:
        with suppress(OSError), a.makefile("rb") as stream:
            while len(size := stream.read(2)) == 2:
                batch = stream.read(int.from_bytes(size, "little"))
                b.sendall(KEEP_ALIVE if forgotten.is_set() else size + batch)
        for one in (a, b):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)


@contextmanager
def client_and_router(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[ZenohBus, ZenohBus, ForgetfulLink]]:
    monkeypatch.setattr(zenoh_bus, "SILENT", 1.0)
    monkeypatch.setattr(zenoh_bus, "UNANSWERED", 2.0)
    port = free_port()
    router = ZenohBus(BusSettings(mode="router", listen=(f"tcp/127.0.0.1:{port}",)))
    link = ForgetfulLink(port)
    client = ZenohBus(BusSettings(endpoints=(f"tcp/127.0.0.1:{link.port}",)))
    try:
        assert client.wait_connected(10.0)
        yield client, router, link
    finally:
        client.close()
        link.close()
        router.close()


@pytest.mark.slow
def test_a_client_that_was_forgotten_connects_again(monkeypatch, caplog):
    """And everything that it has declared is there again; its user sees the server go and come."""
    with client_and_router(monkeypatch) as (client, router, link):
        heard: list[bytes] = []
        alive: list[bool] = []
        router.subscribe("m/up", lambda sample: heard.append(sample.payload))
        router.announce("m/alive/s0")
        client.subscribe("m/down", lambda sample: heard.append(sample.payload))
        client.watch("m/alive/*", lambda key, there: alive.append(there))

        def both_ways() -> bool:
            client.publish("m/up", b"up")
            router.publish("m/down", b"down")
            return {b"up", b"down"} <= set(heard)

        eventually(both_ways)
        eventually(lambda: alive == [True])
        link.forget()
        heard.clear()
        with caplog.at_level(logging.WARNING):
            eventually(both_ways)
        eventually(lambda: alive == [True, False, True])
        assert link.accepted == 2
        assert (
            caplog.messages.count("the router keeps the connection and answers nothing: connecting again")
            == 1
        )


@pytest.mark.parametrize("server", [True, False])
def test_silence_alone_ends_no_connection(monkeypatch, server: bool):
    """The router says who is alive, or that no one is."""
    with client_and_router(monkeypatch) as (client, router, link):
        if server:
            router.announce("m/alive/s0")
        asked: list[str] = []
        answered = ZenohBus._is_answered

        def noted(bus: ZenohBus, session: object) -> bool:
            result = answered(bus, session)  # type: ignore[arg-type]
            asked.append("answered" if result else "silent")
            return result

        monkeypatch.setattr(ZenohBus, "_is_answered", noted)
        client.watch("m/alive/*", lambda key, there: None)
        eventually(lambda: len(asked) >= 3)
        assert set(asked) == {"answered"} and link.accepted == 1


def test_a_bus_is_closed_at_once_while_it_waits_for_a_sign_of_life(monkeypatch):
    with client_and_router(monkeypatch) as (client, _, link):
        monkeypatch.setattr(zenoh_bus, "UNANSWERED", 600.0)
        client.watch("m/alive/*", lambda key, there: None)
        asks = threading.Event()
        answered = ZenohBus._is_answered

        def noted(bus: ZenohBus, session: object) -> bool:
            asks.set()
            return answered(bus, session)  # type: ignore[arg-type]

        monkeypatch.setattr(ZenohBus, "_is_answered", noted)
        link.forget()
        assert asks.wait(30.0)
        closing = threading.Thread(target=client.close)
        closing.start()
        closing.join(10.0)
        assert not closing.is_alive()


@pytest.mark.parametrize("keys", [20, 300])
def test_the_sign_of_life_takes_no_longer_with_many_who_are_alive(monkeypatch, keys: int):
    """One answer was taken at each look: 18 s for twenty of them. And 300 were more than the channel held, so
    that the client waited for ever.
    """
    with client_and_router(monkeypatch) as (client, router, _):
        for k in range(keys):
            router.announce(f"m/alive/r{k}")
        seen: set[str] = set()
        client.watch("m/alive/*", lambda key, there: seen.add(key))
        eventually(lambda: len(seen) == keys)
        answered: list[bool] = []

        def ask() -> None:
            with client.using_session() as session:
                assert session is not None
                answered.append(client._is_answered(session))

        began = time.monotonic()
        asking = threading.Thread(target=ask, daemon=True)
        asking.start()
        asking.join(30.0)
        assert answered == [True] and time.monotonic() - began < 5.0


class Silent:
    """A session whose router says nothing for as long as is waited for it; counts how often one looks."""

    def __init__(self, seconds: float) -> None:
        self.looks = 0
        self._end = time.monotonic() + seconds

    def liveliness(self) -> Silent:
        return self

    def get(self, key: str, handler: object, timeout: float) -> Silent:
        return self

    def try_recv(self) -> None:
        self.looks += 1
        if time.monotonic() > self._end:
            raise zenoh.ZError("channel is empty and closed")


def test_clients_that_wait_for_a_busy_router_do_not_keep_it_busy(monkeypatch):
    """With a look every 50 ms a thousand of them took a core and a half, and starved the server itself."""
    with client_and_router(monkeypatch) as (client, _, _):
        client.watch("m/alive/*", lambda key, there: None)
        silent = Silent(1.2)
        assert client._is_answered(silent)  # type: ignore[arg-type]
        assert silent.looks <= 10


def test_a_client_that_hears_messages_looks_for_silence_once_it_may_be_there(monkeypatch):
    """It looked ten times as often: a thousand robots, five hundred times a second."""
    with client_and_router(monkeypatch) as (client, _, _):
        looks: list[float] = []
        wait = client._woken.wait

        def noted(timeout: float | None = None) -> bool:
            ended = wait(timeout)
            looks.append(time.monotonic())
            return ended

        monkeypatch.setattr(client._woken, "wait", noted)
        end = time.monotonic() + 2.5
        while time.monotonic() < end:
            client.owner.heard()
            time.sleep(0.05)
        assert 1 <= len(looks) <= 4
