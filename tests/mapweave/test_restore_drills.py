"""The drills of docs/operations.md, by its own commands: a dump is restored, and a moment of the past."""

import os
import pwd
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.cli import main
from mapweave.hybridmap.change import ChangeBody, NodeRetired
from mapweave.hybridmap.ids import NodeId
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.postgres_server import PostgresServer, binaries
from tests.mapserver.log.acknowledged_fleet import AGENT, KEYS, life, node
from tests.mapserver.log.test_front_servers import FrontServer, logs_of
from tests.operations_page import PageShell, commands
from tests.waiting import eventually

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

NEEDED = ("pg_dump", "pg_restore", "pg_basebackup", "pg_ctl", "psql", "createdb")
PATIENCE = 120.0


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that PostgreSQL's own user may read, and whose name is short."""
    if find_spec("psycopg") is None:
        pytest.skip("the extra `postgres` is not installed")
    found = binaries()
    if found is None or not all((found / name).exists() for name in NEEDED):
        pytest.skip(f"there is no PostgreSQL with {', '.join(NEEDED)}: Debian's package postgresql")
    folder = Path(tempfile.mkdtemp(prefix="drill-"))
    folder.chmod(0o755)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def postgres(place: Path) -> Iterator[PostgresServer]:
    """A cluster of this test alone: a drill stops it and puts another in its place."""
    (place / "pg").mkdir()
    server = PostgresServer(place / "pg")
    try:
        yield server
    finally:
        server.stop()
        with suppress(AssertionError):  # it may have been started again, or not
            server.run("pg_ctl", "-D", str(server.data), "-m", "immediate", "-w", "stop")


class Fleet:
    """A robot, and a server on the database `maps`."""

    def __init__(self, postgres: PostgresServer, folder: Path) -> None:
        self.address = postgres.address("maps")
        self._hub = MemoryHub()
        self.journal = Journal(folder / "r0", "r0")
        self.map = self.journal.open_map(1)
        self.robot = Replicator(MemoryBus(self._hub), KEYS, self.journal, self.map, ("s0",), AGENT)
        self.serve()

    def serve(self) -> None:
        """Start the server."""
        self.server = FrontServer(self._hub, self.address, "s0")

    def send(self, bodies: list[ChangeBody]) -> None:
        """Map, until the server has it."""
        self.robot.submit(bodies, 1)
        assert self.robot.wait_acknowledged(PATIENCE)

    def close(self) -> None:
        """End the robot."""
        self.robot.close()
        self.journal.close()


def shown(address: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The content hash that `mapweave map show` prints."""
    capsys.readouterr()
    assert main(["map", "show", address, "--no-picture"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "content hash" in line]
    return line.split()[-1]


def test_a_dump_is_restored(postgres: PostgresServer, place: Path, tmp_path, capsys):
    shell = PageShell(postgres, place)
    shell.run("createdb --owner mapweave maps")
    backup, restore = commands("## Backup and restore")
    fleet, rng = Fleet(postgres, tmp_path), np.random.default_rng(3)
    bodies = life(fleet.map, rng, 30)
    fleet.send(bodies[:20])
    monday = shown(fleet.address, capsys)
    shell.run(backup)
    # The robot drops this retirement, since the server has it.
    fleet.send([*bodies[20:], node(fleet.map, 900, rng), NodeRetired(NodeId(*fleet.map, 1))])
    assert fleet.journal.prune(fleet.map, ["s0"]) > 0
    now, store_id = shown(fleet.address, capsys), fleet.server.store.id
    fleet.server.close()

    shell.run(restore)

    assert shown(fleet.address, capsys) == monday != now
    fleet.serve()
    assert fleet.server.store.id == store_id
    eventually(lambda: shown(fleet.address, capsys) == now, PATIENCE)
    shell.run("dropdb maps_before")
    fleet.server.close()
    fleet.close()


def test_a_moment_of_the_past_is_restored(postgres: PostgresServer, place: Path, tmp_path, capsys):
    """Someone deletes everything; PostgreSQL goes back to the moment before, and robots add the rest."""
    if os.geteuid() == 0 and "postgres" not in {user.pw_name for user in pwd.getpwall()}:
        pytest.skip("there is no user postgres")
    own = {"/backup/maps": str(place / "maps"), " -o postgres": "" if os.geteuid() else " -o postgres"}
    shell = PageShell(postgres, place, own)
    shell.run("createdb --owner mapweave maps")
    archive, restore = commands("### To a point in time")
    fleet, rng = Fleet(postgres, tmp_path), np.random.default_rng(4)
    bodies = life(fleet.map, rng, 40)
    fleet.send(bodies[:15])
    shell.run(archive)
    fleet.send(bodies[15:30])
    then = shown(fleet.address, capsys)
    time.sleep(0.1)
    moment = shell.run("psql --tuples-only --no-align --command 'SELECT clock_timestamp()' maps").strip()
    time.sleep(0.1)
    fleet.send([*bodies[30:], node(fleet.map, 900, rng), NodeRetired(NodeId(*fleet.map, 1))])
    assert fleet.journal.prune(fleet.map, ["s0"]) > 0
    now = shown(fleet.address, capsys)
    fleet.server.close()
    shell.run("psql --command 'DELETE FROM mapweave.change' maps")
    assert shown(fleet.address, capsys) not in (then, now)

    assert "2026-03-02 14:00:00+00" in restore
    shell.run(restore.replace("2026-03-02 14:00:00+00", moment))

    in_recovery = "psql --tuples-only --no-align --command 'SELECT pg_is_in_recovery()'"
    eventually(lambda: shell.run(in_recovery).strip() == "f", PATIENCE)
    assert shown(fleet.address, capsys) == then
    shell.run(commands("## Backup and restore")[1].splitlines()[-1])
    fleet.serve()
    eventually(lambda: shown(fleet.address, capsys) == now, PATIENCE)
    assert fleet.server.store.watermark(fleet.map) == fleet.journal.head(fleet.map)
    assert set(logs_of([fleet.journal])[fleet.map]) <= set(fleet.server.logs()[fleet.map])
    fleet.server.close()
    fleet.close()
