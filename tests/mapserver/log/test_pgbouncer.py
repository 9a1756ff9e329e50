"""Servers behind pgbouncer: pooled sessions are like PostgreSQL's own, pooled transactions are refused."""

import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.log.entry import Applied
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.store import EVERYTHING, LEADS, LogChanges, News
from mapweave.storage.postgres_session import PostgresAddress, PostgresSession
from synthetic.postgres_server import PostgresServer
from tests.mapserver.log.test_store import MAP, entry
from tests.pgbouncer import pooled
from tests.waiting import eventually


def test_servers_share_a_store_by_pooled_sessions(postgres: PostgresServer):
    with pooled(postgres, "session") as pooler:
        address = pooler.through(postgres.database())
        stores = [PostgresStore(address, name) for name in ("s0", "s1")]
        heard: list[list[News]] = [[], []]
        for store, news in zip(stores, heard, strict=True):
            store.follow(news.append)
        # Each hears what is written from its first look at everything on.
        eventually(lambda: any(store.leads for store in stores) and all(heard))
        leader, other = sorted(stores, key=lambda store: not store.leads)
        assert not other.leads
        assert leader.apply(MAP, 5, [entry(1), entry(2)]).watermark == 2
        assert other.apply(MAP, 5, [entry(1), entry(2), entry(3)]).before == 2
        taken = News(frozenset([MAP]), frozenset())
        eventually(lambda: all(taken in news for news in heard))
        leader.close()
        eventually(lambda: other.leads)
        other.close()
        assert [[one for one in news if one not in (EVERYTHING, LEADS)] for news in heard] == [
            [taken],
            [taken],
        ], "a server does not hear what it wrote itself"


def test_settings_of_a_session_pass_a_pooler(postgres: PostgresServer):
    with pooled(postgres, "session") as pooler:
        address = PostgresAddress.read(pooler.through(postgres.database()))
        for _ in range(2):
            session = PostgresSession(address, "test", {"idle_session_timeout": "7s"})
            shown = [
                session.connection.execute(f"SHOW {name}").fetchone()
                for name in ("search_path", "idle_session_timeout")
            ]
            assert shown == [("mapweave",), ("7s",)]
            # Its session at PostgreSQL's side is the next one's.
            session.close()


def test_a_query_is_not_taken_for_that_of_another_session(postgres: PostgresServer):
    with pooled(postgres, "session") as pooler:
        address = PostgresAddress.read(pooler.through(postgres.database()))
        sessions = [PostgresSession(address, name) for name in ("s0", "s1")]

        def asked() -> list[tuple[int, int]]:
            return [
                session.connection.execute(f"SELECT {k}, pg_backend_pid() WHERE %s", [True]).fetchall()[0]
                for k, session in enumerate(sessions)
            ]

        for _ in range(10):
            asked()
        pooler.pool("transaction")
        eventually(lambda: len({session for _, session in asked()}) == 1)
        assert [number for number, _ in asked()] == [0, 1]
        for session in sessions:
            session.close()


def test_pooled_transactions_are_refused(postgres: PostgresServer):
    with pooled(postgres, "transaction") as pooler:
        address = pooler.through(postgres.database())
        for name in ("s0", "s1"):
            with pytest.raises(InvalidFile, match="in pgbouncer set pool_mode = session") as refused:
                PostgresStore(address, name)
            assert "\n" not in str(refused.value)


def test_a_pooler_that_begins_to_pool_transactions_is_noticed(postgres: PostgresServer):
    with pooled(postgres, "session") as pooler:
        address = postgres.database()
        stores = [PostgresStore(pooler.through(address), name) for name in ("s0", "s1")]
        for store in stores:
            store.follow(lambda news: None)
        eventually(lambda: any(store.leads for store in stores))
        acknowledged, reasons = 0, set[str]()

        def refused() -> bool:
            nonlocal acknowledged
            for store in stores:
                assert not all(one.leads for one in stores)
                (result,) = store.apply_all([LogChanges(MAP, 5, [entry(acknowledged + 1)])])
                if isinstance(result, Applied):
                    acknowledged = result.watermark
                else:
                    reasons.add(str(result))
            return len(reasons) > 0

        assert not refused()
        pooler.pool("transaction")
        eventually(refused)
        assert all("in pgbouncer set pool_mode = session" in reason for reason in reasons)
        for store in stores:
            store.close()
        kept = PostgresStore(address, read_only=True)
        assert [change.sequence for change in kept.replay(MAP)] == list(range(1, acknowledged + 1))
        kept.close()
