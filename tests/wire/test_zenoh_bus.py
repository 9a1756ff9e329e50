"""What the Zenoh bus must do besides the contract: missing and taken ports, and the process's end."""

import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, closing
from typing import Any

import pytest
import zenoh

from mapweave.hybridmap.errors import NotConnected
from mapweave.wire import zenoh_bus, zenoh_config
from mapweave.wire.bus import Sample
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_entities import Subscription
from tests.waiting import eventually, free_port
from tests.wire.fleets import Routers, ZenohFleet


def test_a_client_may_come_before_its_router(routers: Routers):
    port = free_port()
    begin = time.monotonic()
    client = routers.client(port)
    got: list[Sample] = []
    client.subscribe("a", got.append)
    client.publish("a", b"lost")
    assert client.ask("a", b"", 60.0) == []
    assert not client.wait_connected(0.05)
    assert time.monotonic() - begin < 20
    router = routers.router(port)
    assert client.wait_connected(30)
    eventually(lambda: router.publish("a", b"found") or got)
    assert {s.payload for s in got} == {b"found"}


def test_a_client_whose_session_breaks_while_it_declares_connects_again(
    routers: Routers, monkeypatch, caplog
):
    declare, broken = Subscription._declare_in, iter([True])

    def declare_in(subscription: Subscription, session: zenoh.Session) -> Any:
        if next(broken, False):
            raise zenoh.ZError("the transport is closed")
        return declare(subscription, session)

    monkeypatch.setattr(Subscription, "_declare_in", declare_in)
    port, got = free_port(), list[Sample]()
    routers.client(port).subscribe("a", got.append)
    router = routers.router(port)
    eventually(lambda: router.publish("a", b"found") or got)
    assert "the transport is closed; trying again" in caplog.text


def test_all_questions_to_a_robot_are_one_declaration(zenoh_fleet: ZenohFleet):
    """Eight made a third of what it cost a robot to connect beside 400 others."""
    client = zenoh_fleet.join()
    before = threading.active_count()
    for what in ("mission", "mission/*", "drive", "portal", "portal/*", "status", "log/*", "view"):
        client.serve(f"mapweave/1/fleet/agent/r1/{what}", lambda request: request.reply(b""))
    # Zenoh has a thread for each that takes calls.
    assert threading.active_count() == before + 1


def test_a_client_that_never_connects_closes_at_once(routers: Routers):
    client = routers.client(free_port())
    begin = time.monotonic()
    client.close()
    assert time.monotonic() - begin < 5


def test_a_taken_port_is_reported_in_one_line(zenoh_fleet: ZenohFleet):
    with pytest.raises(NotConnected, match="the port is taken; stop the other server") as error:
        zenoh_fleet.open_router()
    assert "\n" not in str(error.value)
    assert zenoh_fleet.endpoints[0] in str(error.value)


@pytest.mark.slow
@pytest.mark.waits
def test_idle_connections_block_no_other(routers: Routers):
    port = free_port()
    routers.router(port)
    with ExitStack() as stack:
        idle = [stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(150)]
        # With Zenoh's own limits it takes 10 s.
        assert routers.client(port).wait_connected(5.0)
        # Who says nothing is dropped.
        eventually(lambda: all(_is_closed(item) for item in idle))


def _is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(1, socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


@pytest.mark.parametrize("declaring_thread_is_daemon", [False, True])
@pytest.mark.parametrize("closes", [False, True])
def test_the_interpreter_exits_cleanly(declaring_thread_is_daemon: bool, closes: bool):
    """Whether the bus is closed or forgotten, declared from a daemon thread or not, with a question open."""
    program = f"""
import threading, time
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
listen = ("tcp/127.0.0.1:{free_port()}",)
router = ZenohBus(BusSettings(mode="router", listen=listen))
client = ZenohBus(BusSettings(endpoints=listen))
kept = []
def declare():
    client.subscribe("a", lambda sample: None)
    client.serve("b", kept.append)
    router.subscribe("a", lambda sample: None)
    ZenohBus(BusSettings(endpoints=listen)).subscribe("a", lambda sample: None)
assert client.wait_connected(30)
declaring = threading.Thread(target=declare, daemon={declaring_thread_is_daemon})
declaring.start()
declaring.join()
assert [t for t in threading.enumerate() if "pyo3" in t.name and t.daemon] == []
def ask():
    while not kept:
        router.ask("b", b"", 20)
threading.Thread(target=ask, daemon=True).start()
while not kept:
    router.publish("a", b"")
    time.sleep(0.001)
if {closes}:
    client.close()
    router.close()
"""
    finished = subprocess.run([sys.executable, "-c", program], timeout=60, capture_output=True, text=True)
    assert (finished.returncode, finished.stderr) == (0, "")


@pytest.mark.parametrize(("limit", "most"), [("MOST_REPLIES", 20), ("MOST_REPLY_BYTES", 20_000)])
def test_replies_without_end_fill_no_memory(
    limit: str, most: int, zenoh_fleet: ZenohFleet, monkeypatch, caplog
):
    """A client that answers a question again and again filled 1 GB of who had asked."""

    def answer(request: Any) -> None:
        for _ in range(200):
            request._question.query.reply(request.key, bytes(1000))
        request.abandon()

    monkeypatch.setattr(zenoh_bus, limit, most)
    server, client = zenoh_fleet.join(), zenoh_fleet.join()
    log = f"mapweave/1/demo/agent/{limit.lower()}/log/1"
    server.serve(log, answer)
    server.serve("b", lambda request: request.reply(b"b"))
    eventually(lambda: client.ask("b", b"", 5.0))
    for _ in range(2):
        assert len(client.ask(log, b"", 5.0)) == 20
    assert len([one for one in caplog.records if "too many replies" in one.getMessage()]) == 1
    # What still comes of it is no answer to the next question.
    assert [reply.payload for reply in client.ask("b", b"", 5.0)] == [b"b"]


def test_a_router_drops_what_is_too_large(zenoh_fleet: ZenohFleet):
    """From clients; the server's own answers, a whole map for example, are as large as they are."""
    fleet = zenoh_fleet
    client, other = fleet.join(), fleet.join()
    got: list[int] = []
    fleet.router.subscribe("mapweave/x", lambda sample: got.append(len(sample.payload)))
    fleet.router.serve("mapweave/map", lambda request: request.reply(bytes(2**26)))
    fleet.router.serve("mapweave/size", lambda request: request.reply(str(len(request.payload)).encode()))
    other.serve("mapweave/log", lambda request: request.reply(bytes(int(request.payload))))

    def arrived() -> bool:
        for size in (2**20, 2**18 + 1, 2**17):
            client.publish("mapweave/x", bytes(size))
        return bool(got)

    eventually(arrived)
    assert set(got) == {2**17}
    assert client.ask("mapweave/size", bytes(2**18), 5.0)[0].payload == b"262144"
    assert client.ask("mapweave/size", bytes(2**21), 0.5) == []
    assert len(client.ask("mapweave/map", b"", 20.0)[0].payload) == 2**26
    eventually(lambda: fleet.router.ask("mapweave/log", b"1000", 5.0))
    assert len(fleet.router.ask("mapweave/log", str(2**24).encode(), 10.0)[0].payload) == 2**24
    assert fleet.router.ask("mapweave/log", str(2**25 + 1).encode(), 1.0) == []


def test_a_router_puts_no_message_together_that_is_too_large(monkeypatch):
    """What it drops for its kind it has first put together of its fragments, whatever they came to."""
    monkeypatch.setattr(zenoh_config, "LARGEST_MESSAGE", 2**19)
    with closing(ZenohFleet()) as fleet:
        client = fleet.join()
        fleet.router.serve("mapweave/size", lambda request: request.reply(b"%d" % len(request.payload)))
        eventually(lambda: client.ask("mapweave/size", bytes(2**18), 5.0))
        assert client.ask("mapweave/size", bytes(zenoh_config.LARGEST["query"] - 1024), 1.0) == []
        eventually(lambda: client.ask("mapweave/size", bytes(2**18), 5.0))


FROZEN = """
import sys
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
bus = ZenohBus(BusSettings(endpoints=(sys.argv[1],)))
bus.wait_connected(30)
bus.ask("mapweave/map", b"", 60.0)
"""


@pytest.mark.slow
def test_a_client_that_stops_reading_does_not_hold_up_new_keys(zenoh_fleet: ZenohFleet):
    """With 30 MB on their way to it, the router was closed for 16 s, and no one was answered for 17."""
    fleet, asked = zenoh_fleet, threading.Event()
    live = fleet.join()
    process = subprocess.Popen([sys.executable, "-c", FROZEN, fleet.endpoints[0]])

    def answer(request: Any) -> None:
        process.send_signal(signal.SIGSTOP)
        asked.set()
        request.reply(bytes(30_000_000))

    try:
        fleet.router.serve("mapweave/map", answer)
        fleet.router.serve("mapweave/small", lambda request: request.reply(b"here"))
        assert asked.wait(30.0)
        time.sleep(0.2)  # its buffers are full
        began = time.monotonic()
        fleet.router.reopen(BusSettings(mode="router", listen=fleet.endpoints))
        assert time.monotonic() - began < 5.0
        eventually(lambda: live.ask("mapweave/small", b"", 0.5), 10.0)
    finally:
        process.kill()
        process.wait()
