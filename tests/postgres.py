"""A real PostgreSQL server for tests: started in a temporary folder."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from synthetic.postgres_server import PostgresServer, binaries


def started(*options: str) -> Iterator[PostgresServer]:
    """A server until the generator ends; skips the test where there is no PostgreSQL."""
    if find_spec("psycopg") is None:
        pytest.skip("the extra `postgres` is not installed")
    if binaries() is None:
        pytest.skip("there is no PostgreSQL: neither Debian's package postgresql nor PyPI's pgserver")
    # Not below pytest's folder: that is its user's alone.
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    try:
        server = PostgresServer(folder, *options)
        try:
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    """One server for all tests of a process; each takes databases of its own."""
    yield from started()
