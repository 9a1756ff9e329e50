"""What the tests of commands need: a recording, a taken port, an unused endpoint."""

from __future__ import annotations

import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mapweave import MapId, write_map_file
from mapweave.mapserver.map_files import map_file_of
from synthetic.maps import looked_around, merger_of
from tests.described import described_once
from tests.examined import examined_once
from tests.mapweave.command_line import CAMERA
from tests.recordings import write_folder
from tests.simulator import INSTALLED
from tests.waiting import free_port


@pytest.fixture(scope="module", autouse=True)
def examined() -> Iterator[None]:
    """Servers and commands of tests compare the same nodes, and look at the same images, again and again."""
    with examined_once(), described_once():
        yield


@pytest.fixture(scope="session")
def joined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of two robots' maps of one room, merged; tests read it."""
    merged = merger_of(looked_around((MapId("r0", 1), MapId("r1", 1)), seed=6)).merged()
    path = tmp_path_factory.mktemp("map") / "room.mapweave"
    write_map_file(path, map_file_of(merged))
    return path


@pytest.fixture
def signals() -> Iterator[None]:
    """Commands take signals for themselves."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def port() -> Iterator[int]:
    """A port that is taken."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield int(taken.getsockname()[1])


@pytest.fixture
def closed() -> str:
    """An endpoint without a listener."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Three grey images without a robot that moves."""
    images = [np.full((48, 64), 90, np.uint8)] * 3
    return write_folder(tmp_path / "walk", images, [(0, 0)] * 3, CAMERA, timed=True)


@pytest.fixture(scope="session")
def simulator() -> None:
    """PyBullet prints a line when it is loaded first; that is not what is tested."""
    if INSTALLED:
        import mapweave.sim.simulation  # noqa: F401
