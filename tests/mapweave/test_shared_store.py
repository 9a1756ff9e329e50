"""Servers on one PostgreSQL as people run them: killed, and restored from a backup."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
import psycopg
import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.cli import main
from mapweave.exit_status import FAILED
from mapweave.hybridmap.change import ChangeBody, NodeRetired
from mapweave.hybridmap.ids import NodeId
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.opened_map import open_map
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus import Bus
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Scalar, decode_record
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.postgres_server import PostgresServer, binaries
from tests.mapserver.log.acknowledged_fleet import AGENT, life, node
from tests.mapserver.log.test_front_servers import FrontServer, logs_of
from tests.mapweave.test_map_commands import logs
from tests.programs import ran
from tests.waiting import eventually

KEYS = Keys("fleet")
PATIENCE = 120.0


def robot_of(folder: Path, bus: Bus, bodies: list[ChangeBody], name: str) -> tuple[Journal, Replicator]:
    """A robot that sends a map."""
    journal = Journal(folder / name, name)
    replicator = Replicator(bus, KEYS, journal, journal.open_map(1), ("s0",), AGENT)
    replicator.submit(bodies, 1)
    return journal, replicator


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_either_of_two_servers_may_be_killed(postgres: PostgresServer, tmp_path, capfd):
    address = postgres.database()
    ports = {"s0": free_port(), "s1": free_port()}
    endpoints = {name: f"tcp/127.0.0.1:{port}" for name, port in ports.items()}
    maps = list(logs().values())
    with Children(tmp_path / "logs") as children:

        def start(name: str) -> None:
            other = endpoints["s1" if name == "s0" else "s0"]
            children.start(
                name,
                ["server", "--fleet", "fleet", "--name", name, "--store", address,
                 "--data", str(tmp_path / name), "--listen", endpoints[name], "--connect", other],
            )  # fmt: skip

        for name in ports:
            start(name)
        bus = ZenohBus(BusSettings(mode="client", endpoints=tuple(endpoints.values())))

        def status(name: str) -> Mapping[str, Scalar]:
            """Asked again where no answer comes in time, as while the servers' routers find each other."""
            found: list[Mapping[str, Scalar]] = []

            def answered() -> bool:
                replies = bus.ask(KEYS.server_status(name), b"", 5.0)
                found.extend(decode_record(reply.payload) for reply in replies if not reply.error)
                return bool(found)

            eventually(answered, PATIENCE)
            return found[0]

        eventually(lambda: sum(bool(status(name).get("leads")) for name in ports) == 1, PATIENCE)
        robots = [robot_of(tmp_path, bus, maps[0], "r0")]
        assert robots[0][1].wait_acknowledged(PATIENCE)
        (leader,) = (name for name in ports if status(name)["leads"])
        (other,) = ports.keys() - {leader}
        # In the middle of another robot's map.
        robots.append(robot_of(tmp_path, bus, maps[1][:3], "r1"))
        os.kill(children.pid(leader), signal.SIGKILL)
        robots[1][1].submit(maps[1][3:], 1)
        robots.append(robot_of(tmp_path, bus, maps[2], "r2"))
        eventually(lambda: status(other).get("leads"), PATIENCE)
        eventually(lambda: status(other).get("nodes") == 12 and status(other)["components"] == 2, PATIENCE)
        children.end(leader)
        start(leader)
        for _, replicator in robots:
            assert replicator.wait_acknowledged(PATIENCE)
        eventually(lambda: status(leader).get("components") == 2 and status(leader)["settled"], PATIENCE)
        assert (status(leader)["leads"], status(other)["leads"]) == (False, True)
        for _, replicator in robots:
            replicator.close()
        bus.close()
    journals = [journal for journal, _ in robots]
    with closing(PostgresStore(address, read_only=True)) as store:
        stored = {m: [(c.sequence, encode_change(c)) for c in store.replay(m)] for m in store.maps()}
    assert stored == logs_of(journals)
    for journal in journals:
        journal.close()
    capfd.readouterr()
    assert main(["map", "show", address, "--no-picture"]) == 0
    assert "None" not in capfd.readouterr().out
    assert main(["map", "show", address, "--json", "--no-picture"]) == 0
    shown = json.loads(capfd.readouterr().out)
    assert (shown["nodes"], shown["maps"], shown["source"]) == (
        12,
        ["r0.1", "r1.1", "r2.1"],
        "server's store",
    )
    assert main(["map", "extract", address, "-o", str(tmp_path / "maps")]) == 0
    assert sorted(path.name for path in (tmp_path / "maps").iterdir()) == [
        "r0.1.mapweave", "r1.1.mapweave", "r2.1.mapweave",
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_name_is_that_of_one_server(postgres: PostgresServer, tmp_path):
    """A second is refused, others run beside it, a killed one is followed, and a displaced one ends."""
    address = postgres.database()
    endpoints = {name: f"tcp/127.0.0.1:{free_port()}" for name in ("s0", "s1")}
    running: dict[str, subprocess.Popen[bytes]] = {}

    def command(name: str, data: str, *listen: str) -> list[str]:
        return [sys.executable, "-m", "mapweave", "server", "--fleet", "fleet", "--name", name,
                "--store", address, "--data", str(tmp_path / data), "--listen", *listen]  # fmt: skip

    def start(name: str) -> None:
        with (tmp_path / f"{name}.log").open("ab") as log:
            others = [word for other in running for word in ("--connect", endpoints[other])]
            running[name] = subprocess.Popen(
                [*command(name, name, endpoints[name]), *others], stdout=log, stderr=log
            )

    def refused() -> str:
        """Its only line on stderr, but for the one about the tests' PostgreSQL."""
        done = ran(*command("s0", "second", f"tcp/127.0.0.1:{free_port()}"), timeout=None)
        assert done.returncode == FAILED
        (line,) = (line for line in done.stderr.splitlines() if "fsync=off" not in line)
        return line

    try:
        start("s0")
        bus = ZenohBus(BusSettings(mode="client", endpoints=tuple(endpoints.values())))

        def serves(name: str) -> bool:
            """Whether exactly one answers by this name."""
            assert all(process.poll() is None for process in running.values())
            replies = bus.ask(KEYS.server_status(name), b"", 5.0)
            return [bool(reply.error) for reply in replies] == [False]

        eventually(lambda: serves("s0"), PATIENCE)
        start("s1")
        eventually(lambda: serves("s1"), PATIENCE)
        journal, robot = robot_of(tmp_path, bus, next(iter(logs().values())), "r0")
        assert robot.wait_acknowledged(PATIENCE)
        line = refused()
        assert f"a map server s0 runs on this store already (process {running['s0'].pid} on " in line
        assert "--name" in line
        assert serves("s0") and serves("s1")
        running["s0"].kill()
        running["s0"].wait()
        start("s0")
        eventually(lambda: serves("s0"), PATIENCE)
        assert f"(process {running['s0'].pid} on " in refused()
        # As a server whose machine stood still, so that PostgreSQL ended its sessions.
        running["s0"].send_signal(signal.SIGSTOP)
        with psycopg.connect(address, autocommit=True) as people:
            people.execute(
                "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity "
                "WHERE application_name LIKE 'mapweave s0%'"
            )
        with closing(PostgresStore(address, "s0")) as store:
            running["s0"].send_signal(signal.SIGCONT)
            assert running["s0"].wait(PATIENCE) == FAILED
            words = (tmp_path / "s0.log").read_text().splitlines()[-1]
            assert f"another map server s0 (process {os.getpid()} on " in words and "--name" in words
            stored = {m: [(c.sequence, encode_change(c)) for c in store.replay(m)] for m in store.maps()}
        assert stored == logs_of([journal])
        del running["s0"]
        assert serves("s1")
        robot.close()
        journal.close()
        bus.close()
    finally:
        for process in running.values():
            process.kill()
            process.wait()


def need_programs(*names: str) -> None:
    """Skip where PostgreSQL comes without one of its programs."""
    folder = binaries()
    if folder is None or not all((folder / name).exists() for name in names):
        pytest.skip(f"this PostgreSQL comes without {', '.join(names)}")


def dumped(postgres: PostgresServer, database: str) -> str:
    """The file of a backup."""
    dump = str(postgres.folder / f"{database}.dump")
    postgres.run("pg_dump", "--format=custom", "--file", dump, database)
    return dump


def restore(postgres: PostgresServer, database: str, dump: str) -> None:
    with psycopg.connect(postgres.address(), autocommit=True) as people:
        people.execute(f"DROP DATABASE {database}")
        people.execute(f"CREATE DATABASE {database}")
    postgres.run("pg_restore", "--exit-on-error", "--dbname", database, dump)


@pytest.mark.slow
def test_what_a_robot_retired_after_a_backup_goes_when_that_is_restored(postgres: PostgresServer, tmp_path):
    """The robot has dropped the retirement, since the server had it."""
    need_programs("pg_dump", "pg_restore", "psql")
    address, hub = postgres.database(), MemoryHub()
    database = str(psycopg.conninfo.conninfo_to_dict(address)["dbname"])
    server = FrontServer(hub, address, "s0")
    journal = Journal(tmp_path / "r0", "r0")
    map_id, rng = journal.open_map(1), np.random.default_rng(3)
    robot = Replicator(MemoryBus(hub), KEYS, journal, map_id, ("s0",), AGENT)
    robot.submit([node(map_id, number, rng) for number in range(1, 6)], 1)
    assert robot.wait_acknowledged(60)
    dump = dumped(postgres, database)
    robot.submit([NodeRetired(NodeId(*map_id, 2)), node(map_id, 6, rng)], 2)
    assert robot.wait_acknowledged(60)
    now = content_hash(open_map(address).content)
    assert journal.prune(map_id, ["s0"]) == 2
    server.close()

    restore(postgres, database, dump)
    page = (Path(__file__).parents[2] / "docs" / "operations.md").read_text()
    (command,) = re.findall(r"^\$ sudo -u postgres psql maps -c '(INSERT .*)'$", page, re.MULTILINE)
    postgres.run("psql", "--dbname", database, "--set", "ON_ERROR_STOP=1", "-c", command)

    server = FrontServer(hub, address, "s0")
    eventually(lambda: content_hash(open_map(address).content) == now, PATIENCE)
    robot.close()
    server.close()
    journal.close()


@pytest.mark.slow
def test_a_restored_backup_has_the_map_and_robots_add_what_is_newer(postgres: PostgresServer, tmp_path):
    """Into a database of the same name; `test_restore_drills` runs the commands of the page."""
    need_programs("pg_dump", "pg_restore")
    address, hub = postgres.database(), MemoryHub()
    database = str(psycopg.conninfo.conninfo_to_dict(address)["dbname"])
    server = FrontServer(hub, address, "s0")
    journal = Journal(tmp_path / "r0", "r0")
    map_id = journal.open_map(1)
    bodies = life(map_id, np.random.default_rng(3), 30)
    robot = Replicator(MemoryBus(hub), KEYS, journal, map_id, ("s0",), AGENT)
    robot.submit(bodies[:20], 1)
    assert robot.wait_acknowledged(60)
    then = content_hash(open_map(address).content)
    dump = dumped(postgres, database)
    robot.submit(bodies[20:], 2)
    assert robot.wait_acknowledged(60)
    now, store_id = content_hash(open_map(address).content), server.store.id
    server.close()

    restore(postgres, database, dump)

    assert content_hash(open_map(address).content) == then != now
    server = FrontServer(hub, address, "s0")
    assert server.store.id == store_id
    eventually(lambda: server.logs() == logs_of([journal]))
    assert content_hash(open_map(address).content) == now
    robot.close()
    server.close()
    journal.close()
