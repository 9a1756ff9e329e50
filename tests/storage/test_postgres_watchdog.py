"""A PostgreSQL that stands still is given up; one where a commit has to wait is not."""

import threading
import time
from collections.abc import Iterator

import psycopg
import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage import postgres_watchdog
from mapweave.storage.postgres_session import PostgresAddress, PostgresSession
from mapweave.storage.postgres_watchdog import PostgresWatchdog
from synthetic.postgres_server import PostgresServer
from tests.postgres import absent_standby, started
from tests.waiting import eventually


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[PostgresServer]:
    monkeypatch.setattr(postgres_watchdog, "LOOK", 0.05)
    monkeypatch.setattr(postgres_watchdog, "LONG", 0.2)
    yield from started()


def ask(session: PostgresSession, query: str = "SELECT 1") -> object:
    with session.guard():
        return session.connection.execute(query).fetchone()


def test_sessions_with_a_postgresql_that_stands_still_are_given_up(server: PostgresServer):
    used, idle = (PostgresSession(PostgresAddress.read(server.address()), name) for name in ("used", "idle"))
    watchdog = PostgresWatchdog(used, idle)
    assert ask(used) == ask(idle) == (1,)
    server.freeze()
    rescue = threading.Timer(20.0, server.thaw)
    rescue.start()
    try:
        with pytest.raises(InvalidFile, match="PostgreSQL answers nothing"):
            ask(used)
        with pytest.raises(InvalidFile, match="PostgreSQL answers nothing"):
            ask(idle)
    finally:
        rescue.cancel()
        server.thaw()

    def again() -> bool:
        try:
            return ask(used) == ask(idle) == (1,)
        except InvalidFile:
            return False

    eventually(again)
    for one in (used, idle):
        one.close()
    watchdog.close()


def test_a_session_that_waits_for_a_postgresql_that_runs_goes_on_waiting(server: PostgresServer):
    session = PostgresSession(PostgresAddress.read(server.address()), "waits")
    watchdog = PostgresWatchdog(session)
    began = time.monotonic()
    with psycopg.connect(server.address(), autocommit=True) as people:
        people.execute("CREATE TABLE public.made (number INT)")
    with absent_standby(server) as people:
        waiting = threading.Thread(
            target=ask, args=(session, "INSERT INTO public.made VALUES (1) RETURNING 1")
        )
        waiting.start()
        eventually(
            lambda: people.execute("SELECT FROM pg_stat_activity WHERE wait_event = 'SyncRep'").fetchall()
        )
        time.sleep(max(0.0, began + 2.0 - time.monotonic()))
        assert waiting.is_alive()
    waiting.join(20.0)
    assert not waiting.is_alive()
    assert session.is_open
    session.close()
    watchdog.close()
