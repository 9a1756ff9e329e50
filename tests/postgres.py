"""A real PostgreSQL server for tests: started in a temporary folder."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from functools import cache
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
def address(postgres: PostgresServer) -> str:
    """Of a new database."""
    return postgres.database()


def pytest_unconfigure() -> None:
    """Remove the cluster that the others are copies of."""
    if _template.cache_info().currsize:
        shutil.rmtree(_template().folder, ignore_errors=True)


@cache
def _template() -> PostgresServer:
    """A stopped server, as it is when it is new: to make its cluster costs a second of processor time."""
    server = PostgresServer(_folder())
    server.stop()
    return server


def _folder() -> Path:
    # Not below pytest's folder: that is its user's alone.
    return Path(tempfile.mkdtemp(prefix="pg-"))
