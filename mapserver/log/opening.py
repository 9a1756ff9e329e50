"""Opens the store of an address."""

from pathlib import Path

from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store

SCHEMES = ("postgresql://", "postgres://")
"""With which an address of a PostgreSQL database begins (libpq, 34.1.1.2)."""


def is_postgres(address: object) -> bool:
    """Whether this names a PostgreSQL database, and no file."""
    return isinstance(address, str) and address.startswith(SCHEMES)


def open_store(address: Path | str, name: str = "store") -> Store:
    """Open a store, or make one.

    Args:
        address: of a file, or of a PostgreSQL database.
        name: of the server, as PostgreSQL's lists of sessions show it.

    Raises:
        InvalidValue: the address is none, or has a password.
        InvalidFile: it cannot be opened.
    """
    if not is_postgres(address):
        return SqliteStore(Path(address))
    # Without the extra `postgres` there is no psycopg.
    from mapweave.mapserver.log.postgres_store import PostgresStore

    return PostgresStore(str(address), name)
