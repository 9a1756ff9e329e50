"""What a session with PostgreSQL says when there is none: one line, and nothing of libraries."""

import errno
import os
from collections.abc import Iterator
from contextlib import closing, suppress

import psycopg
import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage import postgres_session
from mapweave.storage.postgres_session import PostgresAddress, PostgresSession
from synthetic.postgres_server import PostgresServer
from tests.postgres import started
from tests.waiting import eventually, free_port


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    yield from started()


@pytest.mark.parametrize("what", ["dup", "prepare"])
def test_a_session_that_could_not_be_made_ready_is_not_used(server: PostgresServer, what: str, monkeypatch):
    """No file may be opened any more, and later again: a session without its settings would lose what it
    commits, and one without its mark would fail for ever.
    """
    fails = [True]

    def failing(*_: object) -> None:
        if fails[0]:
            raise OSError(errno.EMFILE, "Too many open files")

    def dup(handle: int) -> int:
        failing()
        return duplicated(handle)

    duplicated = os.dup
    if what == "dup":
        monkeypatch.setattr(os, "dup", dup)
    monkeypatch.setattr(postgres_session, "RETRY", 0.1)
    address = PostgresAddress.read(server.address())
    session = PostgresSession(
        address, "test", {"synchronous_commit": "on"}, prepare=failing if what == "prepare" else bool
    )
    with closing(session):
        for _ in range(2):
            with pytest.raises(InvalidFile, match=r"cannot be used \(Too many open files\)"):
                _ = session.connection
            assert not session.is_open
        fails[0] = False

        def works() -> bool:
            with suppress(InvalidFile), session.transaction() as connection:
                row = connection.execute("SHOW lock_timeout").fetchone()
                return row == ("5s",)
            return False

        eventually(works)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("postgresql://anna@db1/maps", "postgresql://db1/maps"),
        ("postgresql://anna@db1:5433/maps", "postgresql://db1:5433/maps"),
        ("postgresql://anna@db1,db2/maps", "postgresql://db1,db2/maps"),
        ("postgresql://anna@db1:5441,db2:5442/maps", "postgresql://db1:5441,db2:5442/maps"),
        ("postgresql://anna@db1:5441,db2/maps", "postgresql://db1:5441,db2/maps"),
        ("postgresql://anna@/maps?host=db1,db2&port=5433", "postgresql://db1:5433,db2:5433/maps"),
        ("postgresql://anna@[::1]:5433/maps", "postgresql://[::1]:5433/maps"),
        ("postgresql://?service=maps", "postgresql://maps/"),
        ("postgresql:///maps?host=/run/postgresql&port=5433", "postgresql:///run/postgresql:5433/maps"),
    ],
)
def test_an_address_names_its_ports(address: str, words: str):
    assert PostgresAddress.read(address).words == words


def test_each_of_several_machines_is_named_once_with_its_reason():
    first, second = free_port(), free_port()
    address = PostgresAddress.read(f"postgresql://anna@127.0.0.1:{first},127.0.0.1:{second}/maps")
    with pytest.raises(InvalidFile) as away:
        _ = PostgresSession(address, "test").connection
    assert str(away.value) == (
        f"{address.words}: the map store cannot be used (127.0.0.1:{first}: Connection refused; "
        f"127.0.0.1:{second}: Connection refused)"
    )


def test_a_standby_is_named_as_one_that_only_reads(tmp_path):
    servers = started("-c", "default_transaction_read_only=on")
    server = next(servers)
    try:
        # A second machine, of which nothing is there.
        address = PostgresAddress.read(
            f"postgresql://mapweave@/postgres?host={server.folder},{tmp_path}&port=5432"
        )
        with pytest.raises(InvalidFile, match=r"session is read-only; ") as away:
            _ = PostgresSession(address, "test").connection
        assert str(away.value).count("session is read-only") == 1
    finally:
        servers.close()


def test_a_password_that_is_missing_is_looked_for_in_its_file(own_postgres: PostgresServer):
    (own_postgres.data / "pg_hba.conf").write_text("local all all scram-sha-256\n")
    with psycopg.connect(own_postgres.address(), autocommit=True) as connection:
        connection.execute("SELECT pg_reload_conf()")
    address = PostgresAddress.read(own_postgres.address())

    def refused() -> str:
        with closing(PostgresSession(address, "test")) as session:
            try:
                return str(session.connection.info.status)
            except InvalidFile as error:
                return str(error)

    eventually(lambda: "no password supplied: ~/.pgpass (PGPASSFILE) has none" in refused())


def test_a_lock_that_another_session_holds_is_explained(postgres: PostgresServer):
    address = PostgresAddress.read(postgres.database())
    session = PostgresSession(address, "test", {"lock_timeout": "10ms"})
    with psycopg.connect(
        postgres.address(), autocommit=True, dbname=session.connection.info.dbname
    ) as holder:
        holder.execute("CREATE TABLE held (number INT)")
        with holder.transaction(), pytest.raises(InvalidFile, match="another session") as late:
            holder.execute("LOCK TABLE held")
            with session.guard():
                session.connection.execute("INSERT INTO public.held VALUES (1)")
        assert "waits for a standby" in str(late.value)
    session.close()


def test_a_session_that_a_pooler_gave_to_another_is_not_used(postgres: PostgresServer):
    session = PostgresSession(PostgresAddress.read(postgres.database()), "test")
    with session.guard(), session.transaction() as connection:
        connection.execute("CREATE TABLE public.kept (number INT)")
    connection.execute("SELECT set_config('mapweave.session', 'of another', false)")
    shared = "a pooler gives one session to several"
    with pytest.raises(InvalidFile, match=shared), session.guard(), session.transaction():
        connection.execute("INSERT INTO public.kept VALUES (1)")
    assert connection.execute("SELECT count(*) FROM public.kept").fetchone() == (0,)
    session.close()


def test_a_connection_that_is_lost_in_a_pipeline_says_no_more_than_its_error(
    postgres: PostgresServer, caplog
):
    session = PostgresSession(PostgresAddress.read(postgres.database()), "test")
    with pytest.raises(InvalidFile), session.guard(), session.connection.pipeline():
        with psycopg.connect(postgres.address(), autocommit=True) as other:
            other.execute("SELECT pg_terminate_backend(%s)", [session.connection.info.backend_pid])
        session.connection.execute("SELECT 1").fetchone()
    session.close()
    assert not caplog.records


def test_a_server_that_was_killed_is_named_without_guesses(own_postgres: PostgresServer):
    with closing(PostgresSession(PostgresAddress.read(own_postgres.address()), "test")) as session:
        connection = session.connection
        own_postgres.kill()
        with pytest.raises(InvalidFile) as lost, session.guard():
            connection.execute("SELECT 1")
        # A process of PostgreSQL that outlives the first one for a moment says so itself.
        reasons = (
            "server closed the connection unexpectedly",
            "terminating connection due to unexpected postmaster exit",
        )
        assert str(lost.value).endswith(tuple(f"cannot be used ({reason})" for reason in reasons))
