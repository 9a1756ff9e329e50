"""The cable between a robot and the router, on real sockets."""

import contextlib
import math
import socket
import threading
import time

import pytest

from mapweave.scenarios.network_emulator import NetworkEmulator


class Echo:
    """Sends back what comes."""

    def __init__(self):
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self):
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:
                return
            threading.Thread(target=self.serve, args=(connection,), daemon=True).start()

    def serve(self, connection):
        with connection:
            while data := connection.recv(4096):
                connection.sendall(data)


@pytest.fixture
def cable():
    echo = Echo()
    made = NetworkEmulator(echo.port, seed=1)
    yield made
    made.close()
    echo.listener.close()


def talk(connection, data):
    connection.sendall(data)
    answer = b""
    while len(answer) < len(data):
        piece = connection.recv(65536)
        if not piece:
            break
        answer += piece
    return answer


def test_it_carries_bytes_both_ways_and_counts_them(cable):
    data = bytes(range(256)) * 400
    with socket.create_connection(("127.0.0.1", cable.port), 2) as one:
        assert talk(one, data) == data
    assert cable.carried == 2 * len(data)


def test_a_cut_link_breaks_and_accepts_no_connection_until_restored(cable):
    with socket.create_connection(("127.0.0.1", cable.port), 2) as first:
        assert talk(first, b"hello") == b"hello"
        cable.cut()
        assert first.recv(10) == b""
    with (
        socket.create_connection(("127.0.0.1", cable.port), 2) as second,
        contextlib.suppress(ConnectionError),
    ):
        assert talk(second, b"hello") == b""
    cable.restore()
    with socket.create_connection(("127.0.0.1", cable.port), 2) as three:
        assert talk(three, b"hello") == b"hello"


@pytest.mark.slow
@pytest.mark.waits
def test_a_bad_network_is_slow_but_loses_nothing(cable):
    cable.worsen(loss=0.5, delay=0.02)
    with socket.create_connection(("127.0.0.1", cable.port), 2) as one:
        began = time.monotonic()
        for number in range(5):
            assert talk(one, b"%d" % number) == b"%d" % number
        slow = time.monotonic() - began
        # Ten pieces, each delayed; with this seed some have to be sent again.
        assert slow > 0.2 + 0.2
        cable.restore()
        best = math.inf
        for _ in range(20):
            began = time.monotonic()
            assert talk(one, b"quick") == b"quick"
            best = min(best, time.monotonic() - began)
        assert best < 0.04, "not even there and back is delayed"


def test_a_frozen_link_holds_everything_back_until_restored(cable):
    with socket.create_connection(("127.0.0.1", cable.port), 2) as one:
        assert talk(one, b"hello") == b"hello"
        cable.freeze()
        one.sendall(b"hello")
        one.settimeout(0.3)
        with pytest.raises(TimeoutError):
            one.recv(10)
        cable.restore()
        one.settimeout(2)
        assert one.recv(10) == b"hello"


def test_a_half_closed_link_gives_no_answer(cable):
    with socket.create_connection(("127.0.0.1", cable.port), 2) as one:
        assert talk(one, b"hello") == b"hello"
        cable.half_close()
        assert one.recv(10) == b""
    with socket.create_connection(("127.0.0.1", cable.port), 2) as two:
        assert talk(two, b"hello") == b"hello"


def test_a_slow_link_takes_its_time(cable):
    cable.worsen(0.0, 0.0, rate=100e3)
    with socket.create_connection(("127.0.0.1", cable.port), 2) as one:
        began = time.monotonic()
        assert talk(one, bytes(20_000)) == bytes(20_000)
        assert time.monotonic() - began > 0.3


@pytest.mark.slow
@pytest.mark.waits
def test_a_lossy_link_stalls_and_carries_little_but_loses_nothing(cable):
    """As TCP does: after a time that doubles with each loss, and with the throughput of Mathis' formula."""
    cable.lose_segments(0.2, 0.02)
    with socket.create_connection(("127.0.0.1", cable.port), 30) as one:
        took = []
        for number in range(40):
            began = time.monotonic()
            assert talk(one, b"%d" % number) == b"%d" % number
            took.append(time.monotonic() - began)
        # There and back is 0.04 s, and neither way is lost in 0.64 of the cases.
        smooth = sum(seconds < 0.19 for seconds in took)
        assert 15 <= smooth <= 35
        assert min(took) > 0.04 and max(took) > 0.2
        once = [seconds for seconds in took if 0.24 <= seconds < 0.4]
        assert once, "a segment that is lost once comes after 0.2 s"
        data = bytes(100_000)
        began = time.monotonic()
        assert talk(one, data) == data
        # 1.22 * 1448 / (0.04 * sqrt(0.2)) = 98.8 kB a second, each way at the same time.
        assert time.monotonic() - began > 0.8


def test_without_a_router_connections_end(cable, opened):
    lonely = opened(NetworkEmulator(1, seed=0))
    with (
        socket.create_connection(("127.0.0.1", lonely.port), 2) as one,
        contextlib.suppress(ConnectionError),
    ):
        assert one.recv(10) == b""
