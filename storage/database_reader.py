"""Reading an SQLite file without changing anything: not the file, not its folder."""

import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage.file_owner import is_owned
from mapweave.storage.first_bytes import SQLITE
from mapweave.storage.os_errors import unreadable
from mapweave.storage.write_ahead_log import page_size

MAGIC = SQLITE
HEADER = 100
"""Bytes at the beginning of the file. Numbers in them are big-endian."""
COUNTED, PAGES, COUNTED_FOR = slice(24, 28), slice(28, 32), slice(92, 96)
"""The count of changes, the number of pages, and the count of changes for which that number was written."""
WAL_MODE = bytes((2, 2))
"""Bytes 18 and 19 of a file whose changes go to a write-ahead log first."""


@contextmanager
def reading(path: Path, what: str = "file", live: bool = False) -> Iterator[sqlite3.Connection]:
    """A connection that only reads; also in a folder that cannot be written.

    A file next to which there is no write-ahead log is read in place, as immutable: SQLite then makes no
    files beside it. A process that was killed leaves such a log; its last commits are in there alone. SQLite
    would put them into the file, so both are copied and the copy is read. Of a file that is cut off a copy is
    read as well: SQLite opens none that is shorter than its header says. Its reads end at the missing pages.

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
            elif not log.exists() and not cut_off(path):
                uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
            else:
                if owned or (log.exists() and _locked(path)):
                    raise InvalidFile(
                        f"{path}: {what} is in use by another process; stop it, or ask the running server, "
                        "`mapweave map fetch FILE` for example, or read a copy of its store "
                        "(`mapweave map backup`)"
                    )
                copy = Path(folder) / "copy"
                shutil.copyfile(path, copy)
                if cut_off(copy):
                    _end_at_last_page(copy)
                if log.exists():
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


def cut_off(path: Path) -> str:
    """Whether a file is shorter than its header says, in words: power was lost, or a copy ended early.

    Returns:
        Empty if it is whole, or if its header does not say: see "The Database Header" in
        https://www.sqlite.org/fileformat2.html.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(HEADER)
    if len(head) < HEADER or head[COUNTED] != head[COUNTED_FOR]:
        return ""
    (pages,) = struct.unpack(">I", head[PAGES])
    there, whole = path.stat().st_size, page_size(path) * pages
    return f"cut off: {there} of {whole} bytes are there" if there < whole else ""


def is_without_log(path: Path) -> bool:
    """Whether a file is one of a write-ahead log that is not beside it, and of one page, as it begins.

    Raises:
        OSError: it cannot be read.
    """
    log = path.with_name(path.name + "-wal")
    with path.open("rb") as file:
        head = file.read(HEADER)
    written = log.stat().st_size if log.exists() else 0
    return head[18:20] == WAL_MODE and not written and path.stat().st_size == page_size(path)


def _end_at_last_page(path: Path) -> None:
    """Let a file that is cut off say that it ends where it does; the rest of its last page becomes zeros."""
    size = page_size(path)
    pages = -(-path.stat().st_size // size)
    with path.open("r+b") as file:
        file.seek(PAGES.start)
        file.write(struct.pack(">I", pages))
        file.truncate(pages * size)


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
