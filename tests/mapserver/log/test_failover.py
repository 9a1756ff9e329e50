"""A primary with a synchronous standby is lost: the standby has all that was acknowledged, and goes on."""

import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.log.entry import Applied
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.store import LogChanges
from mapweave.storage import postgres_watchdog
from synthetic.postgres_server import ROLE, PostgresServer, binaries
from tests.mapserver.log.test_store import MAP, entry
from tests.postgres import started
from tests.waiting import eventually


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.parametrize(
    ("loss", "words"),
    [(PostgresServer.kill, "Connection refused"), (PostgresServer.freeze, "connection timeout expired")],
)
def test_nothing_acknowledged_is_lost_with_the_primary(
    loss: Callable[[PostgresServer], None], words: str, monkeypatch
):
    monkeypatch.setattr(postgres_watchdog, "LONG", 0.5)
    servers = started()
    primary = next(servers)
    folder = binaries()
    if folder is None or not all((folder / name).exists() for name in ("pg_basebackup", "pg_ctl")):
        pytest.skip("this PostgreSQL comes without pg_basebackup and pg_ctl")
    with tempfile.TemporaryDirectory(prefix="pg-") as other:
        standby = PostgresServer(Path(other), primary=primary)
        with psycopg.connect(primary.address(), autocommit=True) as people:
            people.execute("ALTER SYSTEM SET synchronous_standby_names = 'standby'")
            people.execute("SELECT pg_reload_conf()")
            state = "SELECT sync_state FROM pg_stat_replication"
            eventually(lambda: people.execute(state).fetchall() == [("sync",)])
        # The standby is named first: it takes no changes yet.
        store = PostgresStore(f"postgresql://{ROLE}@/postgres?host={standby.folder},{primary.folder}")
        store.follow(lambda news: None)
        eventually(lambda: store.leads)
        stopping, acknowledged, failures = threading.Event(), 0, list[str]()

        def write() -> None:
            nonlocal acknowledged
            while not stopping.is_set():
                (result,) = store.apply_all([LogChanges(MAP, 5, [entry(acknowledged + 1)])])
                if isinstance(result, Applied):
                    acknowledged = result.watermark
                else:
                    assert isinstance(result, InvalidFile)
                    failures.append(str(result))
                    stopping.wait(0.02)

        writer = threading.Thread(target=write)
        writer.start()
        eventually(lambda: acknowledged >= 50)
        loss(primary)
        at_the_end = acknowledged
        eventually(lambda: failures and words in failures[-1])
        standby.run("pg_ctl", "promote", "-D", str(standby.data))
        eventually(lambda: acknowledged >= at_the_end + 50)
        stopping.set()
        writer.join()
        assert [change.sequence for change in store.replay(MAP)] == list(range(1, acknowledged + 1))
        eventually(lambda: store.leads)
        with pytest.raises(InvalidFile, match="a map server store runs on this store already"):
            PostgresStore(standby.address())
        assert not store.displaced
        store.close()
        standby.stop()
        if primary.process.poll() is None:
            primary.thaw()
        servers.close()
