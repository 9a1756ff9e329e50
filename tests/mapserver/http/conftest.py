"""A server for people on a port of its own."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from mapweave.mapserver.http.web import Web
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.maps import write_store
from tests.browser import Browser
from tests.mapserver.http.person import logs
from tests.mapserver.stub_services import StubServices


@pytest.fixture
def services() -> StubServices:
    return StubServices()


@pytest.fixture
def served(services: StubServices) -> Iterator[Web]:
    with Web(("127.0.0.1", 0), services) as served:
        yield served


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture(scope="module")
def browser(chromium: Browser) -> Iterator[Browser]:
    """One for all modules, as new for each: it takes a second of processor time to start."""
    yield chromium
    chromium.open("about:blank")
    chromium.devtools("Emulation.clearDeviceMetricsOverride")
    chromium.devtools("Emulation.setTouchEmulationEnabled", enabled=False)
    chromium.devtools("Emulation.setEmulatedMedia", features=[])
    chromium.devtools("Network.clearBrowserCookies")
    chromium.errors()


@pytest.fixture(scope="session")
def stored(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a server's store, with the maps of two robots."""
    return write_store(tmp_path_factory.mktemp("written") / "s0.sqlite", logs()).read_bytes()


@pytest.fixture
def server(stored: bytes, tmp_path: Path) -> Iterator[MapServer]:
    path = tmp_path / "s0.sqlite"
    path.write_bytes(stored)
    with MapServer(MemoryBus(MemoryHub()), Keys("demo"), path, "s0") as server:
        assert server.settle(60.0)
        yield server
