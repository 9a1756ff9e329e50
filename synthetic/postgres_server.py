"""A real PostgreSQL server: in a folder of its own, on a Unix socket, as a user that may."""

from __future__ import annotations

import os
import pwd
import select
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path

ROLE = "mapweave"
NEEDED = ("initdb", "postgres")
STARTS = 60.0
"""s in which it takes connections."""


@cache
def binaries() -> Path | None:
    """The folder of PostgreSQL's programs: of Debian's packages, or of the PyPI package pgserver."""
    debian = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
    found = shutil.which("postgres")
    folders = [*reversed(debian), *([Path(found).resolve().parent] if found else [])]
    spec = find_spec("pgserver")
    folders += [Path(place) / "pginstall/bin" for place in (spec and spec.submodule_search_locations) or ()]
    return next((one for one in folders if all((one / name).exists() for name in NEEDED)), None)


class PostgresServer:
    """One cluster with its own processes."""

    def __init__(
        self,
        folder: Path,
        *options: str,
        primary: PostgresServer | None = None,
        template: Path | None = None,
    ) -> None:
        """Make a cluster and start it.

        Args:
            folder: for all it has; short, since a socket's path is.
            options: for `postgres`.
            primary: of which it is a standby, named `standby`.
            template: the `data` of a stopped server, which is copied: that is faster than to make a cluster.
        """
        self.folder, self.data, self._options = folder, folder / "data", options
        self._count = 0
        self._given: list[str] = []
        self._returned: list[str] = []
        # PostgreSQL refuses to run as root.
        name = "postgres" if "postgres" in {user.pw_name for user in pwd.getpwall()} else "daemon"
        self.user = name if os.geteuid() == 0 else None
        if self.user:
            os.chown(folder, pwd.getpwnam(name).pw_uid, pwd.getpwnam(name).pw_gid)
        if template is not None:
            assert not (template / "postmaster.pid").exists(), "files of a running server are no copy"
            subprocess.run(["cp", "-a", template, self.data], user=self.user, check=True, timeout=120)
        elif primary is None:
            self.run(
                "initdb", "-D", str(self.data), "-U", ROLE, "--auth=trust", "--no-sync", "--data-checksums",
                "--encoding=UTF8", "--locale=C",
            )  # fmt: skip
        else:
            origin = f"host={primary.folder} user={ROLE} application_name=standby"
            self.run("pg_basebackup", "-D", str(self.data), "-d", origin, "-R", "-c", "fast", "--no-sync")
        self.start()

    def run(self, program: str, *arguments: str) -> str:
        """One of PostgreSQL's programs, as the server's user; returns what it prints."""
        found = binaries()
        assert found is not None
        done = subprocess.run(
            [found / program, *arguments], user=self.user, cwd=self.folder, env=self._environment(),
            capture_output=True, text=True, check=False, timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, f"{program}: {done.stderr}"
        return done.stdout

    def start(self) -> None:
        """Start it, and wait until it takes connections."""
        found = binaries()
        assert found is not None
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [found / "postgres", "-D", self.data, "-k", self.folder, "-c", "listen_addresses=",
                 "-c", "fsync=off", *self._options],
                user=self.user, cwd=self.folder, env=self._environment(), stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip
        end = time.monotonic() + STARTS
        while not self._ready():
            assert time.monotonic() < end, (self.folder / "log").read_text()
            time.sleep(0.02)

    def freeze(self) -> None:
        """Have it stand still with every session, each of which has a process group of its own."""
        self.process.send_signal(signal.SIGSTOP)  # starts no more
        for child in self._children():
            os.kill(child, signal.SIGSTOP)

    def thaw(self) -> None:
        """Go on after `freeze`."""
        for process in (*self._children(), self.process.pid):
            os.kill(process, signal.SIGCONT)

    def kill(self) -> None:
        """End it as a loss of power does: with every session."""
        self.process.send_signal(signal.SIGSTOP)
        sessions = [os.pidfd_open(child) for child in self._children()]
        self.process.kill()
        for session in sessions:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(session, signal.SIGKILL)
        self.process.wait()
        for session in sessions:
            select.select([session], [], [])  # until it has ended
            os.close(session)

    def stop(self) -> None:
        """End it, and all sessions."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(60)

    def address(self, database: str = "postgres") -> str:
        """The address of a database."""
        return f"postgresql://{ROLE}@/{database}?host={self.folder}"

    def database(self) -> str:
        """The address of an empty one, which no other test is given before `take_back`."""
        import psycopg

        name = next(filter(self._emptied, self._returned), None)
        if name is not None:
            self._returned.remove(name)
        else:
            self._count += 1
            name = f"store_{self._count}"
            with psycopg.connect(self.address(), autocommit=True) as connection:
                connection.execute(f"CREATE DATABASE {name}")
        self._given.append(name)
        return self.address(name)

    def take_back(self) -> None:
        """What was given is no longer used.

        A database is given again once it has no session: to empty one is much faster than to make one.
        """
        self._returned += self._given
        self._given.clear()

    def _emptied(self, name: str) -> bool:
        """Empty a database that was given before; says whether it is as a new one."""
        import psycopg

        with psycopg.connect(self.address(name), autocommit=True) as connection:
            (used,) = connection.execute(
                "SELECT EXISTS (SELECT FROM pg_stat_activity WHERE datname = current_database()"
                " AND backend_type = 'client backend' AND pid <> pg_backend_pid())"
                " OR EXISTS (SELECT FROM pg_class WHERE relnamespace = 'public'::regnamespace)"
            ).fetchone() or (True,)
            if used:
                return False
            schemas = connection.execute(
                "SELECT quote_ident(nspname) FROM pg_namespace"
                " WHERE nspname !~ '^pg_' AND nspname NOT IN ('information_schema', 'public')"
            ).fetchall()
            for (schema,) in schemas:
                connection.execute(f"DROP SCHEMA {schema} CASCADE")
        return True

    def _children(self) -> list[int]:
        postmaster = self.process.pid
        return [*map(int, Path(f"/proc/{postmaster}/task/{postmaster}/children").read_text().split())]

    def _environment(self) -> dict[str, str]:
        return {"PATH": os.environ["PATH"], "LC_ALL": "C", "PGHOST": str(self.folder), "PGUSER": ROLE}

    def _ready(self) -> bool:
        import psycopg

        assert self.process.poll() is None, (self.folder / "log").read_text()
        try:
            psycopg.connect(self.address(), connect_timeout=10).close()
        except psycopg.OperationalError:
            return False
        return True
