"""The commands of docs/operations.md, run as they stand there against a PostgreSQL of a test."""

import os
import re
from collections.abc import Mapping
from pathlib import Path

from synthetic.postgres_server import PostgresServer, binaries
from tests.programs import ran

PAGE = Path(__file__).parents[1] / "docs" / "operations.md"
BLOCK = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
DATA = "/var/lib/postgresql/15/main"
"""Where the page's PostgreSQL has its data."""

SUDO = """#!/bin/bash
# The page's user is the one that runs the test's PostgreSQL; any other is who runs the test.
if [ "$1" = -u ]; then
    shift 2
    if [ -n "$AS_USER" ]; then exec runuser -u "$AS_USER" -- "$@"; fi
fi
exec "$@"
"""
SYSTEMCTL = """#!/bin/bash
# Of the page's unit alone; a PostgreSQL that the test has started itself is stopped in order, too.
[ "$2" = postgresql@15-main ] || exit 1
pg() { sudo -u postgres "$BIN/pg_ctl" -D "$DATA" -w -t 60 "$@" > /dev/null; }
options="-k $PGHOST -c listen_addresses= -c fsync=off"
case "$1" in
    stop | restart) pg -m fast stop ;;
esac
case "$1" in
    start | restart) pg -l "$PGHOST/log.$$" -o "$options" start ;;
esac
"""


def commands(heading: str) -> list[str]:
    """The blocks of commands below a heading of the page, up to the next heading, as scripts."""
    page = PAGE.read_text(encoding="utf-8")
    below = page.partition(f"\n{heading}\n")[2]
    assert below, f"{PAGE.name} has no heading {heading!r}"
    below = re.split(r"^#+ ", below, maxsplit=1, flags=re.MULTILINE)[0]
    return [re.sub(r"^\$ ", "", block, flags=re.MULTILINE) for block in BLOCK.findall(below)]


class PageShell:
    """Runs scripts of the page; `sudo` and `systemctl` do what they would for the test's PostgreSQL."""

    def __init__(self, postgres: PostgresServer, folder: Path, instead: Mapping[str, str] = {}) -> None:
        """Prepare.

        Args:
            postgres: that the page's is; its role `postgres` is a superuser.
            folder: where the scripts run.
            instead: of what the page has of its own machine, as folders and times, what the test has.
        """
        import psycopg

        found = binaries()
        assert found is not None
        self._folder, self._instead = folder, {**instead, DATA: str(postgres.data)}
        shims = folder / "shims"
        shims.mkdir()
        for name, script in (("sudo", SUDO), ("systemctl", SYSTEMCTL)):
            (shims / name).write_text(script)
            (shims / name).chmod(0o755)
        with psycopg.connect(postgres.address(), autocommit=True) as people:
            if not people.execute("SELECT FROM pg_roles WHERE rolname = 'postgres'").fetchall():
                people.execute("CREATE ROLE postgres SUPERUSER LOGIN")
        self._environment = {
            **os.environ, "PATH": f"{shims}:{found}:{os.environ['PATH']}", "LC_ALL": "C",
            "PGHOST": str(postgres.folder), "PGUSER": "postgres", "AS_USER": postgres.user or "",
            "BIN": str(found), "DATA": str(postgres.data),
        }  # fmt: skip

    def run(self, script: str) -> str:
        """Run a script; returns what it prints. The first command that fails ends it, and the test."""
        for words, own in self._instead.items():
            script = script.replace(words, own)
        program = ["bash", "-euo", "pipefail", "-c", script]
        done = ran(*program, cwd=self._folder, env=self._environment, timeout=240)
        assert done.returncode == 0, f"{script}\n{done.stdout}{done.stderr}"
        return done.stdout
