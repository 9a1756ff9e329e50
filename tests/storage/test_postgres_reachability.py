"""Whether waiting may help, of real servers that are down, starting, frozen, or that refuse."""

import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress

import psycopg
import pytest

from mapweave.hybridmap.errors import InvalidFile, StoreAway
from mapweave.storage.postgres_reachability import waiting_may_help
from mapweave.storage.postgres_session import PostgresAddress, PostgresSession
from synthetic import postgres_server
from synthetic.postgres_server import PostgresServer
from tests.pgbouncer import pooled
from tests.postgres import started
from tests.waiting import eventually, free_port


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    yield from started()


def away(address: str) -> bool:
    """What is said of an address that cannot be connected, as for a writer."""
    read = PostgresAddress.read(address)
    session = PostgresSession(read, "test")
    with pytest.raises(StoreAway):
        _ = session.connection
    session.close()
    return waiting_may_help(read)


def test_a_server_that_is_down_may_come(server: PostgresServer):
    server.stop()
    try:
        assert away(server.address())
        assert away(f"postgresql://anna@127.0.0.1:{free_port()}/maps")
    finally:
        server.start()


def test_a_host_whose_name_is_not_known_yet_may_come():
    assert away("postgresql://anna@none.invalid/maps")


def test_a_frozen_server_may_go_on(server: PostgresServer):
    server.freeze()
    try:
        assert away(server.address())
    finally:
        server.thaw()


def test_a_server_that_recovers_takes_sessions_later(server: PostgresServer, monkeypatch):
    """It refuses all sessions while it replays its log, as a standby does that may not be read."""
    server.stop()
    (server.data / "standby.signal").touch()
    settings = server.data / "postgresql.auto.conf"
    before = settings.read_text()
    settings.write_text(f"{before}hot_standby = off\n")
    monkeypatch.setattr(postgres_server, "STARTS", 1.0)
    try:
        with pytest.raises(AssertionError):
            server.start()
        eventually(lambda: "the database system is" in refused(server.address()))
        assert away(server.address())
    finally:
        monkeypatch.undo()
        server.process.send_signal(signal.SIGQUIT)
        server.process.wait(60)
        settings.write_text(before)
        (server.data / "standby.signal").unlink()
        server.start()


def refused(address: str) -> str:
    try:
        psycopg.connect(address, connect_timeout=5).close()
    except psycopg.OperationalError as error:
        return str(error)
    return ""


def test_no_database_user_or_password_comes_by_waiting(server: PostgresServer):
    assert not away(server.address("none"))
    assert not away(server.address().replace("mapweave@", "stranger@"))
    # A machine that is down beside it changes nothing.
    assert not away(f"postgresql://mapweave@/none?host=/none,{server.folder}")
    rules = server.data / "pg_hba.conf"
    before = rules.read_text()
    rules.write_text("local all all scram-sha-256\n")
    server.process.send_signal(signal.SIGHUP)
    try:
        eventually(lambda: "no password supplied" in refused(server.address()))
        assert not away(server.address())
    finally:
        rules.write_text(before)
        server.process.send_signal(signal.SIGHUP)
        eventually(lambda: not refused(server.address()))


def test_a_server_with_too_many_sessions_takes_another_one_later():
    servers = started("-c", "max_connections=8", "-c", "superuser_reserved_connections=3")
    server = next(servers)
    address = server.address().replace("mapweave@", "anna@")
    try:
        with psycopg.connect(server.address(), autocommit=True) as owner:
            owner.execute("CREATE ROLE anna LOGIN")
        with ExitStack() as others:
            for user in (address, server.address()):
                # The slots of all, then those of superusers: refused after and before it is known who asks.
                while not refused(user):
                    # The slot of the session that has just asked is not free at once.
                    with suppress(psycopg.OperationalError):
                        others.enter_context(closing(psycopg.connect(user)))
                assert away(address), refused(address)
        eventually(lambda: not refused(address))
        assert not away(server.address("none").replace("mapweave@", "anna@"))
        with psycopg.connect(server.address(), autocommit=True) as owner:
            owner.execute("ALTER ROLE anna CONNECTION LIMIT 0")
        assert "too many connections for role" in refused(address) and away(address)
    finally:
        servers.close()


def test_one_of_several_standbys_may_become_the_primary():
    servers = started("-c", "default_transaction_read_only=on")
    try:
        assert away(next(servers).address())
    finally:
        servers.close()


@pytest.mark.slow
@pytest.mark.waits
def test_a_pooler_whose_server_is_down_is_waited_for(own_postgres: PostgresServer):
    with pooled(own_postgres, "session") as pooler:
        address = pooler.through(own_postgres.address())
        own_postgres.stop()
        pooler.process.terminate()
        pooler.process.wait(30)
        pooler.process = subprocess.Popen(
            pooler.process.args, user=own_postgres.user, stderr=subprocess.DEVNULL
        )
        eventually(lambda: "/.s.PGSQL" not in refused(address))
        assert away(address)


def test_what_is_wrong_with_a_session_that_was_made_is_no_reason_to_wait(postgres: PostgresServer):
    session = PostgresSession(PostgresAddress.read(postgres.database()), "test")
    with pytest.raises(InvalidFile) as wrong, session.guard():
        session.connection.execute("SELECT * FROM none")
    assert not isinstance(wrong.value, StoreAway)
    with pytest.raises(StoreAway), session.guard():
        with psycopg.connect(postgres.address(), autocommit=True) as other:
            other.execute("SELECT pg_terminate_backend(%s)", [session.connection.info.backend_pid])
        session.connection.execute("SELECT 1")
    session.close()
