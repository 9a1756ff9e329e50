"""A copy of an SQLite file, also of one that a running process writes to."""

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage.atomic_file import check_place, replacing, unwritable
from mapweave.storage.database_reader import reading
from mapweave.storage.os_errors import NO_ROOM

STEP = 1024
"""Pages that are copied between two looks at Ctrl-C, and two reports of progress."""


@contextmanager
def copying(
    source: Path, target: Path, progress: Callable[[int, int], None] = lambda done, of: None
) -> Iterator[Path]:
    """Copy a file as it is at one moment; what was committed before is in the copy.

    Yields the path of the copy, which is checked and may be changed. At the end it gets its name and is on
    the disk; on an error nothing is left of it.

    Args:
        source: may belong to a running process, which does not wait.
        target: must not be there.
        progress: called with how many pages are copied, and of how many.

    Raises:
        InvalidFile: the source is missing, locked or damaged, the target is there already, or the disk has no
            room for it.
    """
    check_new(target)
    with replacing(target) as beside:
        with reading(source, live=True) as connection:
            _copy(connection, source, beside, target, progress)
        beside.chmod(source.stat().st_mode & 0o777)
        _check(beside, source)
        yield beside
        check_new(target)


def check_new(path: Path) -> None:
    """Refuse a place where a file is already, or none can be.

    Raises:
        InvalidFile: see `check_place`.
    """
    there = path.exists() or path.is_symlink()
    if not there or path.is_dir():
        check_place(path)
    if there:
        raise InvalidFile(f"{path}: is there already, and is not written over; give another name")


def _copy(
    connection: sqlite3.Connection,
    source: Path,
    beside: Path,
    target: Path,
    progress: Callable[[int, int], None],
) -> None:
    try:
        pages, page = (connection.execute(f"PRAGMA page_{w}").fetchone()[0] for w in ("count", "size"))
        disk = os.statvfs(target.parent)
        # To fill the disk would stop a server that keeps its store there.
        if pages * page > disk.f_bavail * disk.f_frsize:
            raise unwritable(target, NO_ROOM)
        with closing(sqlite3.connect(beside, isolation_level=None)) as copy:
            # Half a copy is thrown away: there is nothing to roll back.
            copy.execute("PRAGMA journal_mode=OFF")
            connection.backup(copy, pages=STEP, progress=lambda _, left, of: progress(of - left, of))
    except sqlite3.Error as error:
        if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_FULL:
            raise unwritable(target, NO_ROOM) from None
        raise InvalidFile(f"{source}: cannot be copied to {target} ({error})") from None


def _check(copy: Path, source: Path) -> None:
    """Refuse a copy that no program would open."""
    try:
        with reading(copy) as connection:
            found = str(connection.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.Error as error:
        found = str(error)
    if found != "ok":
        raise InvalidFile(
            f"{source}: is damaged ({found.splitlines()[-1]}), and is not copied; save what can be read with "
            "`mapweave map extract FILE -o FOLDER`"
        )
