"""A real pgbouncer in front of a PostgreSQL server of tests."""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg
import pytest

from synthetic.postgres_server import ROLE, PostgresServer
from tests.waiting import eventually

SETTINGS = """
[databases]
* = host={server} user={role}
[pgbouncer]
pool_mode = {mode}
unix_socket_dir = {folder}
listen_port = 5432
auth_type = any
"""


class Pgbouncer:
    """One process.

    Attributes:
        folder: of its socket.
    """

    def __init__(self, program: str, folder: Path, server: PostgresServer, mode: str) -> None:
        """Start it; see `pooled`."""
        self.folder, self._server = folder, server
        self._set(mode)
        if server.user:
            # pgbouncer refuses to run as root.
            os.chown(folder, pwd.getpwnam(server.user).pw_uid, -1)
        with (folder / "log").open("wb") as log:
            self.process = subprocess.Popen(
                [program, folder / "pgbouncer.ini"], user=server.user, stdout=log, stderr=log
            )

    def through(self, address: str) -> str:
        """The address of a database by this pooler."""
        database = psycopg.conninfo.conninfo_to_dict(address)["dbname"]
        return f"postgresql://{ROLE}@/{database}?host={self.folder}"

    def answers(self) -> bool:
        """Whether it takes sessions."""
        try:
            psycopg.connect(self.through(self._server.address())).close()
        except psycopg.OperationalError:
            return False
        return True

    def pool(self, mode: str) -> None:
        """Have the running process pool in another mode."""
        self._set(mode)
        self.process.send_signal(signal.SIGHUP)

    def _set(self, mode: str) -> None:
        text = SETTINGS.format(server=self._server.folder, role=ROLE, mode=mode, folder=self.folder)
        (self.folder / "pgbouncer.ini").write_text(text)


@contextmanager
def pooled(server: PostgresServer, mode: str) -> Iterator[Pgbouncer]:
    """A pgbouncer in this mode; skips the test where none is installed.

    Args:
        server: behind it.
        mode: of pooling.
    """
    program = shutil.which("pgbouncer", path=f"{os.environ['PATH']}:/usr/sbin")
    if program is None:
        pytest.skip("there is no pgbouncer: Debian's package pgbouncer is not installed")
    # Not below pytest's folder: that is its user's alone.
    folder = Path(tempfile.mkdtemp(prefix="pgb-"))
    try:
        pooler = Pgbouncer(program, folder, server, mode)
        try:
            eventually(pooler.answers)
            yield pooler
        finally:
            pooler.process.terminate()
            pooler.process.wait(30)
    finally:
        shutil.rmtree(folder)
