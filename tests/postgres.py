"""A real PostgreSQL server for tests: started in a temporary folder."""

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from synthetic.postgres_server import PostgresServer, binaries
from tests.waiting import eventually

TEMPLATE = "MAPWEAVE_TEST_POSTGRES"
"""Names the folder of the cluster that others are copies of, to all processes of a run."""


def started(*options: str) -> Iterator[PostgresServer]:
    """A server until the generator ends; skips the test where there is no PostgreSQL."""
    if find_spec("psycopg") is None:
        pytest.skip("the extra `postgres` is not installed")
    if binaries() is None:
        pytest.skip("there is no PostgreSQL: neither Debian's package postgresql nor PyPI's pgserver")
    folder = _folder()
    try:
        server = PostgresServer(folder, *options, template=_template())
        try:
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[PostgresServer]:
    """One server for all tests of a process."""
    yield from started()


@pytest.fixture
def postgres(postgres_server: PostgresServer) -> Iterator[PostgresServer]:
    """The same; a test takes databases of its own."""
    yield postgres_server
    postgres_server.take_back()


@pytest.fixture
def own_postgres() -> Iterator[PostgresServer]:
    """One that a test may kill."""
    yield from started()


@contextmanager
def absent_standby(postgres: PostgresServer) -> Iterator[Any]:
    """Commits wait for a standby that is not there; yields a connection by which people look."""
    import psycopg

    with psycopg.connect(postgres.address(), autocommit=True) as people:
        people.execute("ALTER SYSTEM SET synchronous_standby_names = 'absent'")
        people.execute("SELECT pg_reload_conf()")
        try:
            # The setting is in force a little later.
            eventually(lambda: people.execute("SHOW synchronous_standby_names").fetchone() == ("absent",))
            yield people
        finally:
            people.execute("ALTER SYSTEM RESET synchronous_standby_names")
            people.execute("SELECT pg_reload_conf()")


@pytest.fixture
def address(postgres: PostgresServer) -> str:
    """Of a new database."""
    return postgres.database()


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        os.environ[TEMPLATE] = str(_folder())


def pytest_unconfigure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ[TEMPLATE], ignore_errors=True)


def _template() -> Path:
    """The data of a stopped server, as it is when it is new: to make it costs a second of processor time."""
    folder = Path(os.environ[TEMPLATE])
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "made").exists():
            PostgresServer(folder).stop()
            (folder / "made").touch()
    return folder / "data"


def _folder() -> Path:
    # Not below pytest's folder: that is its user's alone.
    return Path(tempfile.mkdtemp(prefix="pg-"))
