"""One PostgreSQL for several servers: a primary with a synchronous standby, which can be lost."""

from __future__ import annotations

import time
from importlib.util import find_spec
from pathlib import Path

from mapweave.scenarios.children import ChildFailed
from synthetic.postgres_server import ROLE, PostgresServer, binaries

NEEDED = ("pg_basebackup", "pg_ctl")
DURABLE = "-c", "fsync=on"
PATIENCE = 60.0
"""Longest wait for the standby, s."""


def can_be_shared() -> bool:
    """Whether there is a PostgreSQL that can have standbys, and the library for it."""
    found = binaries()
    return bool(find_spec("psycopg") and found and all((found / name).exists() for name in NEEDED))


class SharedStore:
    """A primary and its standby, whose commits are on both disks when they return. A context manager."""

    def __init__(self, folder: Path) -> None:
        """Choose a folder, short, since a socket's path is; its own user gets to read it.

        Raises:
            ChildFailed: there is no PostgreSQL, or one without standbys.
        """
        if not can_be_shared():
            raise ChildFailed(
                "needs PostgreSQL with pg_basebackup and pg_ctl, Debian's package postgresql, and psycopg"
            )
        self._folders = [folder / "pg0", folder / "pg1"]
        folder.chmod(0o755)
        for one in self._folders:
            one.mkdir()
        self._servers: list[PostgresServer] = []

    def __enter__(self) -> SharedStore:
        """Start both."""
        try:
            self._servers.append(PostgresServer(self._folders[0], *DURABLE))
            self._servers.append(PostgresServer(self._folders[1], *DURABLE, primary=self._servers[0]))
            self._wait_for_standby()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End both."""
        for server in self._servers:
            server.stop()

    def database(self) -> str:
        """The address of an empty database, which names both machines."""
        address = self._servers[0].database()
        name = address.partition("@/")[2].partition("?")[0]
        hosts = ",".join(map(str, self._folders))
        return f"postgresql://{ROLE}@/{name}?host={hosts}"

    def lose_primary(self) -> None:
        """Kill -9 the primary with all its sessions, and promote the standby at once."""
        primary, standby = self._servers
        primary.kill()
        standby.run("pg_ctl", "promote", "-D", str(standby.data))

    def _wait_for_standby(self) -> None:
        """Have commits wait for the standby from now on."""
        import psycopg

        end = time.monotonic() + PATIENCE
        with psycopg.connect(self._servers[0].address(), autocommit=True) as people:
            people.execute("ALTER SYSTEM SET synchronous_standby_names = 'standby'")
            people.execute("SELECT pg_reload_conf()")
            while people.execute("SELECT sync_state FROM pg_stat_replication").fetchall() != [("sync",)]:
                if time.monotonic() > end:
                    raise ChildFailed(f"the standby does not follow in {PATIENCE:g} s")
                time.sleep(0.05)
