"""The page in a real browser whose server is away: behind a silent network, started again, or full."""

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from websockets.sync.client import connect

from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
from mapweave.mapserver.http.live import MOST_VIEWERS
from mapweave.mapserver.http.serving import ConnectionTimeouts
from mapweave.mapserver.http.web import Web
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import Person
from tests.mapserver.http.test_live import less
from tests.mapserver.stub_services import StubServices, two_maps
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
NODES = "return window.mapweave ? mapweave.model.order.length : 0"
SILENT = "import('/static/live.js').then(({{ limits }}) => {{ limits.silent = {}; }})"


def fewer() -> int:
    """Nodes that are shown before the whole map is there."""
    return len(less(two_maps()).graphs[0].nodes)


class Relay:
    """A network between a browser and a server, which can lose everything without a word."""

    def __init__(self, port: int) -> None:
        self._server, self.works, self.requests_lost = port, True, 0
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        self._sockets = [self._listening]
        self._accepting = threading.Thread(target=self._accept, daemon=True)
        self._accepting.start()

    def close(self) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._accepting.join(10.0)
        for one in self._sockets:
            one.close()

    def _accept(self) -> None:
        while True:
            try:
                browser, _ = self._listening.accept()
                self._sockets.append(browser)
                server = socket.create_connection(("127.0.0.1", self._server))
            except OSError:
                return
            self._sockets.append(server)
            for source, sink in ((browser, server), (server, browser)):
                threading.Thread(target=self._carry, args=(source, sink), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        lost = False
        try:
            while data := source.recv(65536):
                # What was lost once is not made good by TCP: the connection says nothing any more.
                lost = lost or not self.works
                self.requests_lost += lost and data.startswith(b"GET ")
                if not lost:
                    sink.sendall(data)
            if not lost and self.works:
                sink.shutdown(socket.SHUT_WR)
        except OSError:
            return


@pytest.fixture
def relayed(services: StubServices) -> Iterator[tuple[Web, Relay]]:
    limits = ConnectionTimeouts(head=5.0, whole=20.0, stall=1.0)
    with Web(("127.0.0.1", 0), services, limits=limits) as served:
        relay = Relay(served.port)
        yield served, relay
        relay.close()


def test_a_network_that_says_nothing_any_more_is_noticed(
    browser: Browser, services: StubServices, relayed: tuple[Web, Relay]
):
    """As after a phone has slept: the page held a connection on which nothing came, and said "live"."""
    served, relay = relayed
    services.fleet = FleetStatus((RobotEntry("r0", True, 0.2),))
    person = Person(browser)
    browser.open(f"http://127.0.0.1:{relay.port}/")
    eventually(lambda: person.text("connection") == "live" and "r0 alive" in person.text("robots"))
    browser.run(SILENT.format(1500))
    # From the next message on, within 10 s.
    services.fleet = FleetStatus((RobotEntry("r0", True, 0.4), RobotEntry("r1", True)))
    eventually(lambda: "r1 alive" in person.text("robots"))
    relay.works = False
    eventually(lambda: person.text("connection") == "no server, trying again")
    assert "alive" not in person.text("robots")
    # It tries again, and what it asks for then is lost as well.
    eventually(lambda: relay.requests_lost > 0)
    # The server keeps nothing of it either.
    eventually(lambda: served.connections == 0)
    services.map = less(two_maps())
    services.fleet = FleetStatus((RobotEntry("r0", True), RobotEntry("r2", True)))
    browser.run(SILENT.format(25000))
    relay.works = True
    eventually(lambda: person.text("connection") == "live" and "r2 alive" in person.text("robots"))
    eventually(lambda: browser.run(NODES) == fewer())


def test_a_server_that_starts_again_is_shown_as_it_is_now(browser: Browser, services: StubServices):
    person, after = Person(browser), StubServices()
    after.map, after.fleet = less(two_maps()), FleetStatus((RobotEntry("r7", True, 0.1),))
    with Web(("127.0.0.1", 0), services) as served:
        port = served.port
        browser.open(f"http://127.0.0.1:{port}/")
        eventually(lambda: browser.run(NODES) == len(two_maps().poses))
    eventually(lambda: person.text("connection") == "no server, trying again")
    assert browser.run(NODES) == len(two_maps().poses), "the map stays, as last shown"
    with Web(("127.0.0.1", port), after):
        eventually(lambda: person.text("connection") == "live")
        eventually(lambda: "r7 alive" in person.text("robots"))
        assert browser.run(NODES) == fewer()


def test_one_viewer_too_many_is_given_the_reason(browser: Browser, services: StubServices):
    """The page said that there was no server."""
    person = Person(browser)
    with Web(("127.0.0.1", 0), services) as served, ExitStack() as stack:
        for _ in range(MOST_VIEWERS):
            stack.enter_context(connect(f"ws://127.0.0.1:{served.port}/live")).recv(timeout=20)
        browser.open(f"http://127.0.0.1:{served.port}/")
        eventually(lambda: person.text("connection") == f"{MOST_VIEWERS} watch already, trying again")
        assert f"The map server shows nothing: {MOST_VIEWERS} watch already." in person.text("edit-refused")
