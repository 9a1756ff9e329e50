"""The databases that tests are given: each is as a new one, also where another test has used it."""

import psycopg

from mapweave.mapserver.log.postgres_store import PostgresStore
from synthetic.postgres_server import PostgresServer
from tests.mapserver.log.test_store import MAP, entry
from tests.postgres import started
from tests.waiting import eventually

CONTENT = (
    "SELECT 'schema', nspname::text, nspacl::text, pg_get_userbyid(nspowner) FROM pg_namespace"
    " WHERE nspname !~ '^pg_(toast_)?temp_'"
    " UNION ALL SELECT 'relation', oid::regclass::text, relkind::text, '' FROM pg_class"
    " WHERE relname !~ '^pg_toast_'"
    " UNION ALL SELECT 'function', oid::regprocedure::text, '', '' FROM pg_proc"
    " UNION ALL SELECT 'setting', setconfig::text, '', '' FROM pg_db_role_setting"
    " UNION ALL SELECT 'lock', locktype, objid::text, '' FROM pg_locks WHERE locktype = 'advisory'"
    " AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)


def content(address: str) -> list[tuple[str, ...]]:
    with psycopg.connect(address) as connection:
        return sorted(connection.execute(CONTENT).fetchall())


def test_a_database_that_is_given_again_is_as_a_new_one(postgres: PostgresServer):
    new = postgres.database()
    before, others = content(new), {new}
    store = PostgresStore(new)
    store.apply(MAP, 5, [entry(1)])
    store.close()
    assert content(new) != before
    with psycopg.connect(new) as connection:
        connection.execute('CREATE SCHEMA "An other"; CREATE TABLE "An other".a AS SELECT 1 AS number')
    assert postgres.database() not in others, "it has not been taken back"
    postgres.take_back()

    def again() -> bool:
        """Whether it is that one: its sessions end a moment after they were closed."""
        given = postgres.database()
        others.add(given)
        return given == new

    eventually(again)
    assert content(new) == before
    assert others == {new} | {address for address in others if content(address) == before}
    store = PostgresStore(new)
    assert store.maps() == []
    store.close()


def test_a_database_that_is_in_use_or_holds_what_is_not_removed_is_not_given_again(opened):
    servers = opened(started())
    server = next(servers)
    used, filled = server.database(), server.database()
    with psycopg.connect(filled) as connection:
        connection.execute("CREATE TABLE public.held (number INT)")
    with psycopg.connect(used):
        server.take_back()
        assert server.database() not in {used, filled}
