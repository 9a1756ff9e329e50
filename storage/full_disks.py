"""A full disk is one line of the log, whatever cannot be written, and one more once it takes something."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile

log = logging.getLogger(__name__)

CALM = 1.0
"""s in which a database must not fail before it counts as written again: where its disk has no room at all,
its pages still have some, for less than what failed."""


class FullDisk(InvalidFile):
    """A file or a database cannot be written, since its disk is full.

    Attributes:
        place: the file, or the address of the database.
        disk: where the disk is mounted; of a database its address.
        line: of the log.
    """

    place = disk = line = ""

    @staticmethod
    def of_file(words: str, path: Path) -> FullDisk:
        """The error of a file, in these words."""
        error, disk = FullDisk(words), _mounted_at(path)
        error.place, error.disk = str(path.absolute()), disk
        error.line = f"{path}: the disk is full (mounted at {disk}); make room, and what waits is written"
        return error

    @staticmethod
    def of_database(words: str, address: str) -> FullDisk:
        """The error of a database, in its own words."""
        error = FullDisk(words)
        error.place = error.disk = address
        error.line = words
        return error


class _FullDisks:
    """Those of this process, each with the places where nothing was written since."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._lock = threading.Lock()
        self._clock = clock
        self._failing: dict[str, set[str]] = {}
        self._failed_at: dict[str, float] = {}

    def noted(self, error: FullDisk) -> bool:
        """Whether it is news that a disk is full."""
        with self._lock:
            news = error.disk not in self._failing
            self._failing.setdefault(error.disk, set()).add(error.place)
            self._failed_at[error.disk] = self._clock()
            return news

    def written(self, place: str, calm: float) -> bool:
        """Whether it is news that a place takes something, if its disk has not failed for so long, s."""
        # Without the lock: most processes never have a full disk, and this is asked at each commit.
        if not self._failing:
            return False
        with self._lock:
            now = self._clock()
            disks = [
                disk
                for disk, places in self._failing.items()
                if place in places and now - self._failed_at[disk] >= calm
            ]
            for disk in disks:
                del self._failing[disk], self._failed_at[disk]
            return bool(disks)


_full_disks = _FullDisks()


def logged(error: Exception) -> bool:
    """Whether an error is that of a full disk, which is logged here, once for all that cannot be written.

    Any other is the caller's to log.
    """
    if not isinstance(error, FullDisk):
        return False
    if _full_disks.noted(error):
        log.error("%s", error.line)
    return True


def written(place: str | Path, calm: float = 0.0) -> None:
    """Take note that a file, or a database at an address, was written.

    Args:
        place: the file, or the address.
        calm: s in which its disk must not have been full; of a database `CALM`.
    """
    where = str(place.absolute()) if isinstance(place, Path) else place
    if _full_disks.written(where, calm):
        log.warning("%s: the disk has room again; what waited is written", place)


def _mounted_at(path: Path) -> str:
    folder = path.absolute().parent
    while not os.path.ismount(folder) and folder != folder.parent:
        folder = folder.parent
    return str(folder)
