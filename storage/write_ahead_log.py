"""SQLite's write-ahead log: commits in it that SQLite leaves out without a word.

A process that was killed leaves its last commits there. SQLite reads the log up to the first frame whose
checksum is wrong: that is how a commit looks that a loss of power has cut short. But a commit is on the disk
before the next one begins, so where two follow a wrong frame, the disk has changed what was committed.
See "WAL File Format" in https://www.sqlite.org/fileformat2.html.
"""

import struct
from collections.abc import Iterable
from pathlib import Path

HEADER, FRAME = 32, 24
"""Bytes at the beginning of the file and of each frame, by SQLite's file format, section 4.1."""
MAGIC = 0x377F0682
"""The lowest bit says whether checksums are of big-endian words."""
CUT_SHORT = 1
"""Commits that a loss of power can leave behind a wrong frame."""


def lost_commits(database: Path) -> int:
    """How many commits are behind the first wrong frame of the log of a database that no process has open.

    Returns:
        0 if there is no log, if all of it holds, or if a loss of power explains what does not.

    Raises:
        OSError: it cannot be read.
    """
    log = database.with_name(database.name + "-wal")
    if not log.exists():
        return 0
    with log.open("rb") as file:
        data = file.read()
    if len(data) < HEADER + FRAME:
        return 0
    magic, _, page = struct.unpack_from(">3I", data)
    order, size = (">" if magic & 1 else "<"), FRAME + page
    state = _checksum(data[:24], order, (0, 0))
    whole = magic | 1 == MAGIC | 1 and struct.pack(">2I", *state) == data[24:32]
    if not whole:
        # The page size is that of the database's own header, and the salts are those of the first frame.
        page = page_size(database)
        size = FRAME + page
    salts = data[16:24] if whole else data[HEADER + 8 : HEADER + 16]
    lost = 0
    for begin in range(HEADER, len(data) - size + 1, size):
        head = data[begin : begin + FRAME]
        if whole:
            state = _checksum(head[:8] + data[begin + FRAME : begin + size], order, state)
            whole = head[8:16] == salts and struct.pack(">2I", *state) == head[16:24]
        lost += not whole and head[8:16] == salts and head[4:8] != bytes(4)
    return lost if lost > CUT_SHORT else 0


def _checksum(data: bytes, order: str, state: tuple[int, int]) -> tuple[int, int]:
    words: Iterable[tuple[int, int]] = struct.iter_unpack(f"{order}2I", data)
    first, second = state
    for one, two in words:
        first = (first + one + second) & 0xFFFFFFFF
        second = (second + two + first) & 0xFFFFFFFF
    return first, second


def page_size(database: Path) -> int:
    """Bytes of a page, by the header of the file; 512, the least there is, if it does not say."""
    with database.open("rb") as file:
        (size,) = struct.unpack(">H", file.read(18)[16:18].rjust(2, b"\0"))
    return 1 << 16 if size == 1 else max(int(size), 512)
