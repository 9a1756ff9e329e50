"""A fleet behind a plain router of Zenoh, by the configuration that is printed for a zenohd."""

import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.cli import main
from mapweave.hybridmap.change import Change
from mapweave.hybridmap.ids import MapId
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.scenarios.children import Children
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.codec import encode_change
from mapweave.wire.credentials import Role
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Mark
from mapweave.wire.senders import sent_by
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapserver.log.acknowledged_fleet import AGENT, node
from tests.waiting import eventually, free_port

PATIENCE = 90.0
KEYS = Keys("demo")
ROUTER = """
import sys, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    print("ready", flush=True)
    sys.stdin.read()
"""


class PlainRouter:
    """Zenoh's router in a process of its own, by a file."""

    def __init__(self, config: Path) -> None:
        self._config = config
        self.start()

    def start(self) -> None:
        """Start it, and wait until it listens."""
        self._process = subprocess.Popen(
            [sys.executable, "-c", ROUTER, self._config], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"ready\n"

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.communicate()


class Robot:
    """The link of a robot."""

    def __init__(self, folder: Path, name: str, settings: BusSettings) -> None:
        self.bus = ZenohBus(settings)
        self.journal = Journal(folder / f"{name}.journal", name)
        self.map = self.journal.open_map(1)
        self.replicator = Replicator(self.bus, KEYS, self.journal, self.map, ("s0",), AGENT)
        self._rng, self._number = np.random.default_rng(6), 0

    def map_on(self) -> None:
        """A few nodes; until the server has them."""
        self._number += 5
        nodes = [node(self.map, k, self._rng) for k in range(self._number - 4, self._number + 1)]
        self.replicator.submit(nodes, 1)
        assert self.replicator.wait_acknowledged(PATIENCE)

    def close(self) -> None:
        self.replicator.close()
        self.bus.close()
        self.journal.close()


@pytest.fixture(params=["no keys", *Profile])
def fleet(
    request: pytest.FixtureRequest, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Iterator[tuple[PlainRouter, Robot, Robot, Path, bool]]:
    """The router, two robots, the folder of a server that is the router's client; are there keys?"""
    port, folder = free_port(), None
    endpoint = f"tcp/127.0.0.1:{port}"
    if request.param != "no keys":
        folder = KeyFolder.create(tmp_path / "keys", "demo", request.param, [], "s0", port)
        endpoint = folder.catalogue.endpoints[0]
        for name in ("r0", "r1"):
            folder.add(name, Role.ROBOT)
    network = ["--fleet", "demo"] if folder is None else ["--keys", str(tmp_path / "keys")]
    capsys.readouterr()
    assert main(["router", "--print-config", "--listen", endpoint, *network]) == 0
    config = tmp_path / "router.json5"
    config.write_text(capsys.readouterr().out)
    with ExitStack() as stack:
        router = PlainRouter(config)
        stack.callback(router.kill)
        children = stack.enter_context(Children(tmp_path / "logs"))
        children.start("s0", ["server", "--data", str(tmp_path / "s0"), "--connect", endpoint, *network])
        robots = []
        for name in ("r0", "r1"):
            credentials = folder and read_key_file(folder.key_file(name)).credentials
            robots.append(Robot(tmp_path, name, BusSettings(endpoints=(endpoint,), credentials=credentials)))
            stack.callback(robots[-1].close)
        yield router, robots[0], robots[1], tmp_path / "s0", folder is not None
        children.check()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_changes_and_questions_pass_and_forged_ones_do_not(
    fleet: tuple[PlainRouter, Robot, Robot, Path, bool],
):
    router, first, second, data, keys = fleet
    first.map_on()
    second.map_on()
    # Without keys a robot may publish as another one; with them the file's rules forbid it.
    forged = MapId("r1", 77)
    change = encode_change(Change(forged, 1, 1, node(forged, 1, np.random.default_rng(7))))
    for _ in range(3):
        first.bus.publish(KEYS.change(forged), change, Mark(1, 5).encode())
        second.map_on()
    router.kill()
    first.replicator.submit([node(first.map, 900, np.random.default_rng(8))], 1)
    assert first.replicator.flush(PATIENCE)
    router.start()
    assert first.replicator.wait_acknowledged(PATIENCE)
    second.map_on()
    errors: list[str] = []

    def refused() -> bool:
        replies = second.bus.ask(sent_by(KEYS.any_relocalize(), "r1"), b"no view", 5.0)
        errors.extend(one.error for one in replies)
        return bool(replies)

    eventually(refused, PATIENCE)
    assert all(errors), "the question reaches the server, which finds no view in it"
    with closing(sqlite3.connect(f"file:{data / 's0.sqlite'}?mode=ro", uri=True)) as store:
        logs = {MapId(*row[:2]): row[2] for row in store.execute("SELECT agent, epoch, watermark FROM log")}
    assert logs == {first.map: 6, second.map: 25} | ({} if keys else {forged: 1})
