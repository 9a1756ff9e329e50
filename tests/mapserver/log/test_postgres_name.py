"""One server at a time has a name on a store that servers share."""

import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psycopg
import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.log import postgres_name
from mapweave.mapserver.log.entry import Applied
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.store import LogChanges
from synthetic.postgres_server import ROLE, PostgresServer
from tests.mapserver.log.test_store import MAP, entry
from tests.pgbouncer import pooled
from tests.postgres import absent_standby
from tests.waiting import eventually

Start = Callable[..., subprocess.Popen[str]]
HOLDER = """
import sys, time
from mapweave.mapserver.log.postgres_store import PostgresStore
from tests.mapserver.log.test_store import MAP, entry
store = PostgresStore(sys.argv[1], "s0")
print("has it", flush=True)
if len(sys.argv) > 2:
    store.apply(MAP, 5, [entry(1)])
time.sleep(600)
"""


def refusal(address: str, name: str = "s0") -> str:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(InvalidFile) as refused:
        # The other server does not end meanwhile.
        patch.setattr(postgres_name, "PATIENCE", 0.1)
        PostgresStore(address, name)
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.fixture
def another() -> Iterator[Start]:
    """Starts a process that has opened the store as s0; such processes end with the test."""
    processes: list[subprocess.Popen[str]] = []

    def start(address: str, *arguments: str) -> subprocess.Popen[str]:
        words = [sys.executable, "-c", HOLDER, address, *arguments]
        processes.append(process := subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
        assert process.stdout is not None and process.stdout.readline() == "has it\n"
        return process

    yield start
    for process in processes:
        end(process)


def end(process: subprocess.Popen[str]) -> None:
    with process:
        process.kill()


ALL, WITH_NAME = "true", "pid IN (SELECT pid FROM pg_locks WHERE locktype = 'advisory')"
WITHOUT = f"NOT {WITH_NAME}"
"""Which sessions of a server."""


def end_sessions(address: str, which: str) -> None:
    """As where PostgreSQL loses its clients."""
    with psycopg.connect(address, autocommit=True) as people:
        ended = people.execute(
            "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity "
            f"WHERE application_name LIKE 'mapweave s0%' AND datname = current_database() AND {which}"
        ).fetchall()
    assert ended == [(True,)] * (2 if which == ALL else 1)


def test_a_second_server_of_a_name_is_refused_with_what_is_known_of_the_first(address: str):
    first = PostgresStore(address, "s0")
    words = refusal(address)
    assert f"process {os.getpid()} on {socket.gethostname()}, connected since 20" in words
    assert "map server s0 " in words and "end it, or start this one with another --name" in words
    other = PostgresStore(address, "s1")
    readers = [PostgresStore(address, "s0", read_only=True) for _ in range(2)]
    assert first.apply(MAP, 5, [entry(1)]).watermark == 1
    assert other.apply(MAP, 5, [entry(1), entry(2)]).before == 1
    assert all(reader.watermark(MAP) == 2 for reader in readers), "who only reads needs no name"
    first.close()
    PostgresStore(address, "s0").close()
    for store in (other, *readers):
        store.close()


def test_a_name_is_that_of_one_database(postgres: PostgresServer):
    for store in [PostgresStore(postgres.database(), "s0") for _ in range(2)]:
        store.close()


def test_a_refused_server_changes_nothing_for_the_first(address: str):
    first = PostgresStore(address, "s0")
    assert first.apply(MAP, 5, [entry(1)]).watermark == 1
    refusal(address)
    assert not first.displaced
    assert first.apply(MAP, 5, [entry(2)]).watermark == 2
    first.close()


def test_a_server_that_was_killed_is_followed_by_one_of_its_name(address: str, another: Start):
    process = another(address)
    assert f"process {process.pid} on " in refusal(address)
    end(process)
    PostgresStore(address, "s0").close()


def test_the_name_of_a_killed_server_is_free_while_its_commit_waits_for_a_standby(
    postgres: PostgresServer, address: str, another: Start
):
    """Lost robots get answers meanwhile."""
    PostgresStore(address, "s0").close()
    waits = "SELECT 1 FROM pg_stat_activity WHERE wait_event = 'SyncRep'"
    with absent_standby(postgres) as people:
        process = another(address, "and writes")
        eventually(lambda: people.execute(waits).fetchall())
        end(process)
        store = PostgresStore(address, "s0")
        assert store.watermark(MAP) == 0
        assert people.execute(waits).fetchall(), "it waits on: what it commits is not to be cut short"
    eventually(lambda: store.watermark(MAP) == 1)
    store.close()


@pytest.mark.parametrize("which", [ALL, WITH_NAME, WITHOUT], ids=["all", "with-name", "without"])
def test_a_name_that_was_lost_with_its_session_is_taken_again(address: str, which: str):
    store = PostgresStore(address, "s0")
    store.apply(MAP, 5, [entry(1)])
    end_sessions(address, which)
    if which != ALL:
        assert store.watermark(MAP) == 1
    assert first_applied(store, 2) == 2, "where both were lost, before anything is read"
    refusal(address)
    assert not store.displaced
    store.close()


def first_applied(store: PostgresStore, sequence: int) -> int:
    """Where the log stands once a change was taken: the first attempt finds that its session is lost."""
    results: list[Applied] = []

    def taken() -> bool:
        (result,) = store.apply_all([LogChanges(MAP, 5, [entry(sequence)])])
        results.extend([result] if isinstance(result, Applied) else [])
        return bool(results)

    eventually(taken)
    return results[0].watermark


@pytest.mark.parametrize(
    ("which", "writes"), [(ALL, True), (ALL, False), (WITH_NAME, False)], ids=["writes", "reads", "with-name"]
)
def test_a_server_whose_name_another_has_taken_meanwhile_acknowledges_nothing_more(
    address: str, which: str, writes: bool, another: Start, monkeypatch
):
    displaced = PostgresStore(address, "s0")
    assert displaced.apply(MAP, 5, [entry(1)]).watermark == 1
    end_sessions(address, which)
    process = another(address)
    monkeypatch.setattr(postgres_name, "PATIENCE", 0.1)
    if not writes:
        with pytest.raises(InvalidFile, match="took this name"):
            displaced.watermark(MAP)
    for _ in range(3):
        (result,) = displaced.apply_all([LogChanges(MAP, 5, [entry(2)])])
        assert isinstance(result, InvalidFile)
    eventually(lambda: displaced.apply_all([LogChanges(MAP, 5, [entry(2)])]) and displaced.displaced)
    assert f"(process {process.pid} on " in displaced.displaced and "\n" not in displaced.displaced
    end(process)
    monkeypatch.undo()
    # For good: the name may be another's by then.
    for _ in range(3):
        (result,) = displaced.apply_all([LogChanges(MAP, 5, [entry(2)])])
        assert str(result) == displaced.displaced
    with pytest.raises(InvalidFile, match="took this name"):
        displaced.watermark(MAP)
    store = PostgresStore(address, "s0")
    assert store.watermark(MAP) == 1
    store.close()
    displaced.close()


class Cut:
    """Between a server and PostgreSQL: a network that can be cut so that PostgreSQL does not notice."""

    def __init__(self, folder: Path, server: PostgresServer) -> None:
        self._to = str(server.folder / ".s.PGSQL.5432")
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(folder / ".s.PGSQL.5432"))
        self._listener.listen()
        self._near: list[socket.socket] = []
        self.far: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """End what the server sees of its connections."""
        for one in self._near:
            one.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listener.close()
        for one in (*self._near, *self.far):
            one.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.socket(socket.AF_UNIX)
                far.connect(self._to)
                self._near.append(near)
                self.far.append(far)
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._pass, args=ends, daemon=True).start()

    @staticmethod
    def _pass(source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                target.sendall(data)


@pytest.fixture
def network(postgres: PostgresServer) -> Iterator[tuple[Cut, Path]]:
    with tempfile.TemporaryDirectory(prefix="cut-") as folder:
        cut = Cut(Path(folder), postgres)
        yield cut, Path(folder)
        cut.close()


def test_a_server_whose_network_was_cut_does_not_wait_for_its_own_former_session(
    address: str, network: tuple[Cut, Path]
):
    cut, folder = network
    database = psycopg.conninfo.conninfo_to_dict(address)["dbname"]
    store = PostgresStore(f"postgresql://{ROLE}@/{database}?host={folder}", "s0")
    store.apply(MAP, 5, [entry(1)])
    cut.cut()
    # PostgreSQL has not noticed: to it the session still holds the name.
    assert "runs on this store already" in refusal(address)
    assert first_applied(store, 2) == 2
    assert store.watermark(MAP) == 2 and not store.displaced
    refusal(address)
    store.close()


def test_names_pass_a_pooler_of_sessions(postgres: PostgresServer):
    with pooled(postgres, "session") as pooler:
        address = pooler.through(postgres.database())
        for _ in range(3):
            # Sessions of the one before are passed on.
            store = PostgresStore(address, "s0")
            refusal(address)
            other = PostgresStore(address, "s1")
            assert re.search(r"a map server s1 runs on this store already", refusal(address, "s1"))
            store.close()
            other.close()


def test_pooled_transactions_leave_no_name_behind(postgres: PostgresServer):
    address = postgres.database()
    with pooled(postgres, "transaction") as pooler:
        with pytest.raises(InvalidFile, match="in pgbouncer set pool_mode = session"):
            PostgresStore(pooler.through(address), "s0")
        # While the pooler keeps its session.
        PostgresStore(address, "s0").close()
