"""Backups of a store: copies that a server can be started on later, when robots have gone on."""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from mapweave.mapserver.log.integrity import good_rows, insert
from mapweave.mapserver.plan_images import copy_images
from mapweave.storage.database_copy import copying


def back_up(source: Path, target: Path, progress: Callable[[int, int], None]) -> None:
    """Copy a store, and the images of floor plans beside it; a server may run on it.

    Args:
        source: of the store.
        target: of the copy; must not be there.
        progress: called with how many pages are copied, and of how many.

    Raises:
        InvalidFile: see `copying`; nothing is left of the copy.
    """
    with copying(source, target, progress) as copy:
        _compare_later(copy)
        copy_images(source, target)


def _compare_later(copy: Path) -> None:
    """Let a server that starts on the copy compare each log with its robot's.

    A robot drops what later changes undo, and at last the retirement, once servers have it. What was retired
    after the backup would stay in the map of a server that starts on it.
    """
    with closing(sqlite3.connect(copy, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")
        connection.execute("BEGIN IMMEDIATE")
        for row in [*good_rows(connection, "log")]:
            if row is not None and row[3] > 0:
                insert(connection, "unverified", (row[0], row[1], 1, row[3]))
        connection.execute("COMMIT")
