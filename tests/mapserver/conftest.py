"""A small fleet's store, and views of the same rooms."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapweave.hybridmap.pose import Pose2
from mapweave.wire.memory import MemoryHub
from synthetic.maps import changes_of, write_store
from synthetic.world import room, take_map
from tests.examined import examined_once
from tests.mapserver.house import ROBOT, House, MappedRoom
from tests.mapserver.played import HandAgent, Server


@pytest.fixture(scope="module", autouse=True)
def examined() -> Iterator[None]:
    """Servers and commands of tests compare the same nodes again and again."""
    with examined_once():
        yield


@pytest.fixture(scope="session")
def mapped_room(tmp_path_factory: pytest.TempPathFactory) -> Callable[[], MappedRoom]:
    """Makes a new store at each call."""
    rng = np.random.default_rng(4)
    world = room(0, 0, 5, 4, 600, rng)
    stops = [Pose2(2.2 + 0.1 * k, 1.8 + 0.05 * k, 0.9 * k) for k in range(7)]
    nodes, edges = take_map(world, ROBOT, stops, rng)
    truth = {node.id: stop for node, stop in zip(nodes, stops, strict=True)}
    log = {ROBOT: changes_of(nodes, edges)}
    stored = write_store(tmp_path_factory.mktemp("written") / "s0.sqlite", log).read_bytes()

    def make() -> MappedRoom:
        path = tmp_path_factory.mktemp("store") / "s0.sqlite"
        path.write_bytes(stored)
        return MappedRoom(path, world, truth)

    return make


@pytest.fixture
def house(mapped_room: Callable[[], MappedRoom]) -> Iterator[House]:
    """A map server in it, and a person."""
    house = House(mapped_room())
    yield house
    house.close()


@pytest.fixture
def started(hub: MemoryHub, tmp_path: Path) -> Iterator[Callable[..., Server]]:
    """Starts an ingest, s0, with the given quotas or settings; it ends with the test."""
    servers: list[Server] = []

    def start(**options: Any) -> Server:
        servers.append(Server(hub, tmp_path / "s0.sqlite", **options))
        return servers[-1]

    yield start
    # First the agents: those that never answer are asked for as long as they are there.
    for bus in [bus for bus in hub._buses if bus not in [server.bus for server in servers]]:
        bus.close()
    for server in servers:
        server.end()


@pytest.fixture
def server(started: Callable[..., Server]) -> Server:
    """An ingest, s0."""
    return started()


@pytest.fixture
def agent(hub: MemoryHub) -> HandAgent:
    """The client of it."""
    return HandAgent(hub)
