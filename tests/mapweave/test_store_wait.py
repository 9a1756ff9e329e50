"""A server that starts before its database: it waits where that can help, and ends with a line where not."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from mapweave.connection import no_server, server_statuses, waits_for
from mapweave.exit_status import FAILED
from mapweave.hybridmap.errors import InvalidFile, StoreAway
from mapweave.mapserver.map_history import MapHistory
from mapweave.mapserver.server import MapServer
from mapweave.processes.store_wait import Waiting, WaitingServer, made_with_store
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.postgres_server import PostgresServer
from tests.mapweave.command_line import complaint
from tests.postgres import started
from tests.programs import going
from tests.waiting import eventually, free_port

PATIENCE = 120.0
LATE = 5.0
"""s that the database starts after the server."""


class Store:
    """One that is there after some attempts."""

    def __init__(self, *failures: Exception) -> None:
        self.failures = [*failures]
        self.log: list[str] = []
        self.shown: list[str] = []
        self.asked = 0
        self.helps = True

    def make(self) -> str:
        if self.failures:
            raise self.failures.pop(0)
        return "made"

    def may_help(self) -> bool:
        self.asked += 1
        return self.helps

    def wait(self, longest: float = 60.0, stop: threading.Event | None = None) -> str | None:
        waiting = Waiting(self.log.append, self.shown.append)
        return made_with_store(self.make, self.may_help, waiting, stop or threading.Event(), longest)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mapweave.processes.store_wait.EVERY", 0.01)


def test_a_store_that_is_there_is_not_waited_for():
    store = Store()
    assert store.wait() == "made"
    assert (store.log, store.shown, store.asked) == ([], [], 0)


def test_a_wait_is_one_line_and_its_end_another():
    store = Store(*[StoreAway("refused")] * 3, *[StoreAway("it starts")] * 3)
    assert store.wait() == "made"
    assert store.log == ["waiting for at most 60 s: refused", "the map store is there, after 0 s"]
    assert store.shown == [*["waiting: refused"] * 3, *["waiting: it starts"] * 3, ""]
    assert store.asked == 2, "only a failure with other words is looked into"


def test_what_waiting_does_not_mend_ends_at_once_also_later():
    store = Store(StoreAway("no such database"))
    store.helps = False
    with pytest.raises(StoreAway, match="no such database"):
        store.wait()
    assert not store.log and not store.shown
    store = Store(StoreAway("refused"), InvalidFile("another format"))
    with pytest.raises(InvalidFile, match="another format"):
        store.wait()


def test_a_wait_ends_after_its_time_and_when_it_is_stopped():
    store = Store(*[StoreAway("refused")] * 1000)
    with pytest.raises(StoreAway, match="refused"):
        store.wait(0.1)
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    assert store.wait(60.0, stop) is None


def test_who_asks_for_a_servers_status_hears_that_it_waits(opened):
    hub, keys = MemoryHub(), Keys("fleet")
    bus, asker = MemoryBus(hub), MemoryBus(hub)
    waits = opened(WaitingServer(bus, keys, "s0"))
    assert server_statuses(asker, keys, 1.0) == []
    for words in ("waiting: refused", "waiting: it starts"):
        waits.show(words)
        (status,) = server_statuses(asker, keys, 1.0)
        assert (status["loading"], status["settled"], status["event"]) == (True, False, words)
        assert waits_for(status) == f"map server s0 is {words}"
        assert str(no_server(asker, keys)) == f"map server s0 is {words}"
    alive = list[str]()
    asker.watch(keys.servers_alive(), lambda key, there: alive.append(key))
    waits.show("")
    assert server_statuses(asker, keys, 1.0) == [] and not alive
    assert "no map server of fleet fleet answers" in str(no_server(asker, keys))


def test_a_database_that_goes_again_while_the_server_is_made_is_waited_for(
    postgres: PostgresServer, tmp_path, monkeypatch
):
    """What was opened is closed: its session would hold the server's name against the next attempt."""
    address, away = postgres.database(), [StoreAway("gone again")]

    def history(*arguments: Any, **named: Any) -> MapHistory:
        if away:
            raise away.pop()
        return MapHistory(*arguments, **named)

    monkeypatch.setattr("mapweave.mapserver.server.MapHistory", history)
    log = list[str]()
    with closing(MemoryBus(MemoryHub())) as bus:
        made = made_with_store(
            lambda: MapServer(bus, Keys("fleet"), address, "s0", cache=tmp_path),
            lambda: True, Waiting(log.append, log.append), threading.Event(), 60.0,
        )  # fmt: skip
        assert made is not None and log[0] == "waiting for at most 60 s: gone again"
        with made:
            pass


@contextmanager
def server(folder: Path, store: str, *options: str, **environment: str) -> Iterator[subprocess.Popen[bytes]]:
    """A map server as people start it, with its log in a file."""
    command = [
        sys.executable, "-m", "mapweave", "server", "--store", store, "--data", str(folder / "data"),
        "--listen", f"tcp/127.0.0.1:{free_port()}", *options,
    ]  # fmt: skip
    with (
        (folder / "log").open("wb") as log,
        going(*command, stdout=log, stderr=log, env=os.environ | environment) as process,
    ):
        yield process


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.timeout(300)
def test_a_server_waits_for_a_database_that_starts_later(tmp_path):
    databases = started()
    database, http = next(databases), free_port()
    address = database.database()
    database.stop()

    def status() -> dict:
        try:
            with urlopen(f"http://127.0.0.1:{http}/status", timeout=10) as reply:
                return json.load(reply)
        except OSError:
            return {}

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE)
        try:
            with server(
                tmp_path, address, "--http", str(http), NOTIFY_SOCKET=manager.getsockname()
            ) as process:
                eventually(lambda: status().get("event"), PATIENCE)
                assert status()["loading"] and str(database.folder) in str(status()["event"])
                assert status()["summary"] == status()["event"]
                time.sleep(LATE)
                database.start()
                eventually(lambda: status().get("leads") and not status()["event"], PATIENCE)
                process.send_signal(signal.SIGINT)
                assert process.wait(PATIENCE) == 0
        finally:
            databases.close()
        messages = []
        while messages[-1:] != [b"READY=1"]:
            messages.append(manager.recv(1000))
    assert len(messages) >= LATE, "each second"
    assert all(
        re.match(rb"EXTEND_TIMEOUT_USEC=600000000\nSTATUS=postgresql://", one) for one in messages[:-1]
    )
    lines = (tmp_path / "log").read_text().splitlines()
    waits = [line for line in lines if "waiting" in line or "store is there" in line]
    assert len(waits) == 2 and "waiting for at most 600 s: postgresql://" in waits[0]
    assert "the map store is there, after " in waits[1]


@pytest.mark.slow
@pytest.mark.waits
def test_a_server_ends_at_once_where_there_is_no_such_database(postgres: PostgresServer, tmp_path):
    with server(tmp_path, postgres.address("none")) as process:
        assert process.wait(PATIENCE) == FAILED
    (line,) = (tmp_path / "log").read_text().splitlines()
    assert 'database "none" does not exist' in line


@pytest.mark.slow
@pytest.mark.waits
def test_a_server_that_waits_can_be_stopped_and_gives_up(tmp_path, capfd):
    pytest.importorskip("psycopg")
    nowhere, router = f"postgresql://anna@127.0.0.1:{free_port()}/maps", f"tcp/127.0.0.1:{free_port()}"
    with server(tmp_path, nowhere, "--listen", router) as process:
        eventually(lambda: "waiting for at most 600 s" in (tmp_path / "log").read_text(), PATIENCE)
        for command in (["status"], ["map", "history"], ["status", "--json"]):
            said = complaint(capfd, *command, "--connect", router)
            assert re.match(r"mapweave: map server s0 is waiting: postgresql://127.*refused", said)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0
    assert (tmp_path / "log").read_text().splitlines()[-1].endswith("stopped while it was starting")
    with server(tmp_path, nowhere, "--store-wait", "2") as process:
        assert process.wait(PATIENCE) == FAILED
    first, last = (tmp_path / "log").read_text().splitlines()
    assert "waiting for at most 2 s" in first and "Connection refused" in last
