"""Connections of real clients: slow, broken, ambiguous or hostile ones block no other."""

import asyncio
import resource
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

from mapweave.hybridmap.errors import NotConnected, SettingsError
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.mapserver.http import places, serving
from mapweave.mapserver.http.body import MOST_BYTES
from mapweave.mapserver.http.serving import ConnectionTimeouts
from mapweave.mapserver.http.web import Questions, Web, parse_address
from mapweave.wire.log_messages import Scalar
from tests.mapserver.http.client import ask, post, raw
from tests.mapserver.stub_services import StubServices
from tests.waiting import eventually

NEVER = ConnectionTimeouts(head=600.0, whole=600.0)
"""What holds up others does so for longer than any test waits."""


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (b"Content-Length: 99999999999\r\n", b"413"),
        (b"Content-Length: %d\r\nExpect: 100-continue\r\n" % (MOST_BYTES + 1), b"413"),
        (b"Content-Length: -1\r\n", b"400"),
        (b"Transfer-Encoding: chunked\r\n", b"411"),
        (b"", b"411"),
        (b"Content-Length: 0\r\n", b"400"),
    ],
)
def test_lengths_that_are_refused_before_anything_is_read(served: Web, head: bytes, status: bytes):
    got = raw(served, b"POST /relocalize HTTP/1.1\r\nHost: localhost\r\n" + head + b"\r\n")
    assert got.startswith(b"HTTP/1.1 " + status)
    assert b'{"error":' in got
    assert got.count(b"HTTP/1.1") == 1


def test_a_too_long_request_gets_an_answer(served: Web):
    status, answer = post(served, body=bytes(MOST_BYTES + 1))
    assert (status, answer) == (413, {"error": "at most 16 MiB are taken"})


HEAD = b"POST /relocalize HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/png\r\n"
HALF = HEAD + b"Content-Length: 1000\r\n\r\nabc"


def test_closed_or_slow_connections_block_no_other(services: StubServices):
    with Web(("127.0.0.1", 0), services, patience=0.5) as served:
        # No client is left to read an answer.
        assert raw(served, HALF, close=True) == b""
        slow = [socket.create_connection(("127.0.0.1", served.port)) for _ in range(places.MOST_AT_ONCE + 4)]
        for connection in slow:
            connection.sendall(HALF)
        assert ask(served, "GET", "/status")[0] == 200
        assert post(served)[0] == 200
        assert slow[0].recv(65536).startswith(b"HTTP/1.1 408")
        for connection in slow:
            connection.close()


def test_a_byte_now_and_then_takes_no_longer_than_anything_else(services: StubServices):
    with (
        Web(("127.0.0.1", 0), services, patience=0.5) as served,
        socket.create_connection(("127.0.0.1", served.port), timeout=20) as slow,
    ):
        slow.sendall(HALF)
        assert drip(slow, b"x").startswith(b"HTTP/1.1 408")


def test_a_head_that_never_ends_is_dropped(services: StubServices):
    with (
        Web(("127.0.0.1", 0), services, limits=ConnectionTimeouts(head=0.5)) as served,
        socket.create_connection(("127.0.0.1", served.port), timeout=20) as slow,
    ):
        slow.sendall(b"GET /status HTTP/1.1\r\nHost: localhost\r\nX: ")
        assert drip(slow, b"x") == b""


def test_a_client_that_reads_nothing_is_dropped(services: StubServices):
    services.events = (MapEvent(10**18, MapEventKind.CONSTRAINED, "no" * 2000),) * 3000
    with (
        Web(("127.0.0.1", 0), services, limits=ConnectionTimeouts(stall=0.5)) as served,
        socket.socket() as slow,
    ):
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(("127.0.0.1", served.port))
        slow.sendall(b"GET /history HTTP/1.1\r\nHost: localhost\r\n\r\n")
        eventually(lambda: served.connections == 1)
        eventually(lambda: served.connections == 0)
        assert len(ask(served, "GET", "/history")[2]) > 10_000_000


def drip(connection: socket.socket, piece: bytes) -> bytes:
    """Send a little now and then until there is an answer, or the end of the connection."""
    begin = time.monotonic()
    connection.settimeout(0.1)
    while time.monotonic() < begin + 5.0:
        try:
            connection.sendall(piece)
            return connection.recv(65536)
        except TimeoutError:
            continue
        except ConnectionError:
            return b""
    raise AssertionError("it may go on for ever")


def test_thousands_of_half_open_connections_block_no_other(services: StubServices):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 8192), hard))
    half = []
    try:
        with Web(("127.0.0.1", 0), services, limits=NEVER) as served:
            for k in range(2000):
                half.append(socket.create_connection(("127.0.0.1", served.port), timeout=20))
                half[-1].sendall(
                    (b"", b"G", b"GET / HTTP/1.1\r\n", b"POST /relocalize HTTP/1.1\r\nHost: x")[k % 4]
                )
            begin = time.monotonic()
            assert post(served)[0] == 200
            assert ask(served, "GET", "/status")[0] == 200
            assert time.monotonic() < begin + 5.0
            assert served.connections <= serving.MAX_WAITING + 2
    finally:
        for connection in half:
            connection.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (b"Content-Length: 3\r\nTransfer-Encoding: chunked\r\n", b"400"),
        (b"Content-Length: 3\r\nContent-Length: 4\r\n", b"400"),
        (b"Transfer-Encoding: chunked\r\nTransfer-Encoding: identity\r\n", b"400"),
        (b"Content-Length : 3\r\n", b"400"),
        (b"Content-Length: +3\r\n", b"400"),
        (b"Content-Length: 3\r\n X: y\r\n", b"400"),
        (b"X: a\x00b\r\nContent-Length: 3\r\n", b"400"),
    ],
)
def test_ambiguous_requests_are_answered_once(served: Web, head: bytes, status: bytes):
    """What stands behind the first request is never taken for a second one."""
    got = raw(
        served,
        b"POST /relocalize HTTP/1.1\r\nHost: localhost\r\n" + head + b"\r\nabc"
        b"GET /status HTTP/1.1\r\nHost: localhost\r\n\r\n",
    )
    assert got.startswith(b"HTTP/1.1 " + status) and got.count(b"HTTP/1.1 ") == 1
    assert b'{"error":' in got


UPGRADE = (
    b"GET /live HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n%s"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
ANSWERS = {
    b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n": b"200",
    b"GET /static/page.js HTTP/1.1\r\nHost: localhost\r\n\r\n": b"200",
    b"GET /nothing HTTP/1.1\r\nHost: localhost\r\n\r\n": b"404",
    b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n": b"403",
    HEAD + b"\r\n": b"411",
    b"noise\r\n\r\n": b"400",
    UPGRADE % b"Origin: http://evil.example\r\n": b"403",
}


@pytest.mark.parametrize("request_", ANSWERS)
def test_every_answer_has_the_headers_and_names_no_version(served: Web, request_: bytes):
    got = raw(served, request_, close=request_.startswith(b"noise"))
    head = got.partition(b"\r\n\r\n")[0].lower()
    assert got.startswith(b"HTTP/1.1 " + ANSWERS[request_])
    for header in (
        b"x-content-type-options: nosniff", b"x-frame-options: deny", b"referrer-policy: no-referrer",
        b"cross-origin-opener-policy: same-origin", b"cross-origin-resource-policy: same-origin",
        b"cache-control: no-store", b"server: mapweave",
    ):  # fmt: skip
        assert head.count(b"\r\n" + header + b"\r\n") == 1 or head.endswith(b"\r\n" + header), header
    assert b"frame-ancestors 'none'" in head and b"default-src 'none'" in head and b"unsafe" not in head
    assert not any(word in got.lower() for word in (b"uvicorn", b"starlette", b"wsproto", b"python/"))


@pytest.mark.parametrize("path", ["/constraints", "/annotations", "/plans", "/relocalize"])
@pytest.mark.parametrize(
    "kind", ["", "text/plain", "application/x-www-form-urlencoded", "image/svg+xml", "x"]
)
def test_a_body_of_another_type_is_refused(served: Web, path: str, kind: str):
    """Among them are those that a form of another site's page sends without asking first."""
    stated = b"Content-Type: %s\r\n" % kind.encode() if kind else b""
    head = b"POST %s HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n" % path.encode()
    got = raw(served, head + stated + b"\r\n{}")
    assert got.startswith(b"HTTP/1.1 415") and b"send Content-Type: " in got


def test_one_request_a_connection(served: Web):
    got = raw(served, b"GET /status HTTP/1.1\r\nHost: localhost\r\n\r\n" * 3)
    assert got.count(b"HTTP/1.1 200") == 1 and b"\r\nconnection: close\r\n" in got.lower()


def test_a_server_that_is_closed_leaves_nothing_behind(services: StubServices):
    with (
        Web(("127.0.0.1", 0), services, patience=600.0, limits=NEVER) as served,
        socket.create_connection(("127.0.0.1", served.port)) as half,
    ):
        half.sendall(HALF)
        eventually(lambda: served.connections == 1)
        assert "http" in {thread.name for thread in threading.enumerate()}
        begin = time.monotonic()
        served.close()
        assert time.monotonic() < begin + 5.0
        assert "http" not in {thread.name for thread in threading.enumerate()}
        served.close()
        with Web(("127.0.0.1", served.port), services) as again:
            assert ask(again, "GET", "/status")[0] == 200


def test_a_server_ends_without_delay(services: StubServices):
    took = []
    for _ in range(5):
        with Web(("127.0.0.1", 0), services) as served:
            assert ask(served, "GET", "/status")[0] == 200
            begin = time.monotonic()
            served.close()
            took.append(time.monotonic() - begin)
    assert min(took) < 0.1  # s


def test_a_request_in_work_is_answered_when_the_server_ends(services: StubServices):
    begun = threading.Event()

    def slow_status() -> dict[str, Scalar]:
        begun.set()
        time.sleep(0.3)
        return {"summary": "late"}

    services.status = slow_status  # type: ignore[method-assign]
    with Web(("127.0.0.1", 0), services) as served, ThreadPoolExecutor() as client:
        answer = client.submit(ask, served, "GET", "/status")
        assert begun.wait(10.0)
        served.close()
        assert answer.result()[0] == 200 and b"late" in answer.result()[2]


def test_requests_that_come_as_the_server_ends_are_answered(served: Web):
    """They were reset, or got neither an answer nor an end until the process had ended."""
    with ExitStack() as stack:

        def connect() -> socket.socket:
            return stack.enter_context(socket.create_connection(("127.0.0.1", served.port), timeout=20))

        connected = [connect() for _ in range(3)]
        eventually(lambda: served.connections == 3)
        # It does nothing while they come.
        served._loop.call_soon_threadsafe(time.sleep, 0.5)
        clients = [*connected, *(connect() for _ in range(3))]
        for client in clients:
            client.sendall(b"GET /status HTTP/1.1\r\nHost: localhost\r\n\r\n")
        served.close()
        assert [client.recv(12) for client in clients] == [b"HTTP/1.1 200"] * 6


def test_noise_instead_of_http(served: Web):
    rng = np.random.default_rng(3)
    for length in (1, 50, 5000):
        raw(served, rng.bytes(length) + b"\r\n\r\n", close=True)
    assert post(served)[0] == 200


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("8080", ("127.0.0.1", 8080)),
        ("0", ("127.0.0.1", 0)),
        ("0.0.0.0:80", ("0.0.0.0", 80)),
        ("robot.local:8080", ("robot.local", 8080)),
        ("[::1]:8080", ("::1", 8080)),
    ],
)
def test_addresses(text: str, address: tuple[str, int]):
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["", "x", ":80", "65536", "-1", "a:b", "8080:", "²"])
def test_addresses_that_are_none(text: str):
    with pytest.raises(SettingsError, match=r"write a port, or HOST:PORT"):
        parse_address(text)


def test_a_port_that_is_taken(served: Web, services: StubServices):
    with pytest.raises(NotConnected, match=r"cannot listen at http 127.0.0.1:\d+: the port is taken"):
        Web(("127.0.0.1", served.port), services)
    with pytest.raises(NotConnected, match="address"):
        serving.HttpThread(Questions(services, 1.0).app, ("192.0.2.1", 8080))


WITHOUT_FILES = """
import logging, resource, socket, sys, time, urllib.request
from mapweave.mapserver.http.serving import ConnectionTimeouts, HttpThread

logging.basicConfig(format="%(message)s")

async def app(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"here"})

with HttpThread(app, ("127.0.0.1", 0), ConnectionTimeouts(600.0, 600.0, 600.0)) as thread:
    address = "127.0.0.1", thread.port
    held = [socket.create_connection(address)]
    while not thread.connections:
        time.sleep(0.01)
    # The client is in the same process: only what is accepted fails.
    calls, opened = [0], socket.socket.accept
    def full(listening):
        calls[0] += 1
        raise OSError(24, "Too many open files")
    socket.socket.accept = full
    held += [socket.create_connection(address) for _ in range(20)]
    time.sleep(5.0)
    socket.socket.accept = opened
    body = urllib.request.urlopen(f"http://127.0.0.1:{thread.port}/", timeout=30.0).read()
print(body.decode(), calls[0])
"""


def test_a_server_that_can_open_no_more_files_says_so_in_one_line_and_goes_on():
    """By itself asyncio writes thousands of tracebacks a second, until the disk is full."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_FILES], capture_output=True, text=True, timeout=120, check=True
    )
    words, calls = done.stdout.split()
    assert words == "here"
    assert done.stderr.splitlines() == ["no more connections can be taken: Too many open files"]
    assert int(calls) <= 10, "it is tried once a second"


def test_who_has_connected_is_answered_when_a_busy_server_ends():
    """While a library loads or computes, the server's thread comes to nothing for a while, again and again.

    It gave up on requests after a time in which it had not looked for them, and reset their connections.
    """
    busy = threading.Event()

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if not busy.is_set():
            hold_up()
            busy.set()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"4")]})
        await send({"type": "http.response.body", "body": b"here"})

    def hold_up() -> None:
        time.sleep(0.06)
        asyncio.get_running_loop().call_soon(hold_up)

    thread = serving.HttpThread(app, ("127.0.0.1", 0))
    with ExitStack() as stack:

        def asked() -> socket.socket:
            peer = stack.enter_context(socket.create_connection(("127.0.0.1", thread.port), timeout=20.0))
            peer.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            return peer

        peers = [asked()]
        assert busy.wait(10.0)
        peers += [asked() for _ in range(4)]
        thread.close()
        assert [peer.makefile("rb").read()[-4:] for peer in peers] == [b"here"] * 5
