"""Reading an SQLite file without changing anything: not the file, not its folder."""

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage.file_owner import is_owned
from mapweave.storage.first_bytes import SQLITE
from mapweave.storage.os_errors import unreadable

MAGIC = SQLITE


@contextmanager
def reading(path: Path, what: str = "file", live: bool = False) -> Iterator[sqlite3.Connection]:
    """A connection that only reads; also in a folder that cannot be written.

    A file next to which there is no write-ahead log is read in place, as immutable: SQLite then makes no
    files beside it. A process that was killed leaves such a log; its last commits are in there alone. SQLite
    would put them into the file, so both are copied and the copy is read.

    Args:
        path: of the file.
        what: for the errors, for example `agent journal`.
        live: also a file that a process has open as a Database, as it is at one moment: between two of its
            commits. The process goes on writing, and keeps in the write-ahead log what is newer.

    Raises:
        InvalidFile: there is no such file, it cannot be opened, or another process has it open for writing.
    """
    if not path.is_file():
        raise InvalidFile(f"{path}: no such file")
    log = path.with_name(path.name + "-wal")
    try:
        with tempfile.TemporaryDirectory() as folder:
            owned = is_owned(path)
            if live and owned:
                uri = f"{path.absolute().as_uri()}?mode=ro"
            elif not log.exists():
                uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
            else:
                if owned or _locked(path):
                    raise InvalidFile(
                        f"{path}: {what} is in use by another process; stop it, or ask the running server, "
                        "`mapweave map fetch FILE` for example, or read a copy of its store "
                        "(`mapweave map backup`)"
                    )
                copy = Path(folder) / "copy"
                shutil.copyfile(path, copy)
                shutil.copyfile(log, copy.with_name("copy-wal"))
                uri = copy.as_uri()
            with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as connection:
                # Text with a flipped bit may be no UTF-8; its meaning is checked by the reader.
                connection.text_factory = lambda data: data.decode("utf-8", "replace")
                if live and owned:
                    _hold(connection, path, what)
                yield connection
    except OSError as error:
        raise unreadable(path, error) from None


def _hold(connection: sqlite3.Connection, path: Path, what: str) -> None:
    """Let a connection see the file as it is now, whatever is written meanwhile."""
    try:
        connection.execute("BEGIN")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.Error as error:
        if "locked" in str(error):
            raise InvalidFile(
                f"{path}: {what} is in use by a process that lets no other read it, for want of disk space "
                "or on a network file system; stop it first"
            ) from None
        raise InvalidFile(f"{path}: {what} cannot be read ({error})") from None


def _locked(path: Path) -> bool:
    """Whether a process has locked the file. Makes no file, if a write-ahead log is there already."""
    uri = f"{path.absolute().as_uri()}?mode=ro&readonly_shm=1"
    try:
        with closing(sqlite3.connect(uri, uri=True, timeout=1.0)) as connection:
            connection.execute("PRAGMA schema_version").fetchone()
    except sqlite3.Error as error:
        # Any other error is not of the lock: without shared memory the log itself cannot be opened.
        return "locked" in str(error)
    return False
