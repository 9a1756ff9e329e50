"""Rows of an SQLite file by its pages alone, where the tree that leads to them is broken.

A page that is lost takes with it, for SQLite, all pages that it leads to. What these hold is found here page
by page, as "B-tree Pages" and "Record Format" in https://www.sqlite.org/fileformat2.html describe them.
Nothing says whether a row is of the table that is wanted, or was deleted since: the caller needs checksums.
"""

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path

from mapweave.storage.write_ahead_log import page_size

INTERIOR, LEAF = 0x02, 0x0A
"""First bytes of the pages of a table WITHOUT ROWID, or of an index."""
FILE_HEADER = 100
INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
"""Bytes of an integer, by its serial type."""
MOST_READS = 4
"""Overflow pages that are read in all, of the pages of the file. A page belongs to one row, and to copies of
it in pages that were freed since; rows that all claim the same pages would take the square of the length."""

Value = int | bytes | None


def rows_of_pages(path: Path, columns: int) -> Iterator[tuple[Value, ...]]:
    """All rows of tables WITHOUT ROWID that whole pages hold, but for those of pages that are free.

    Args:
        path: of the file; of its write-ahead log nothing is read.
        columns: rows of another number of columns are left out; numbers with a fraction are None in them, and
            text is bytes.

    Raises:
        OSError: it cannot be read.
    """
    if path.stat().st_size <= FILE_HEADER:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        pages = _Pages(data, page_size(path))
        free = pages.free()
        for number in range(2, pages.count + 1):
            if number in free:
                continue
            for payload in pages.payloads(number):
                values = _values(payload)
                if len(values) == columns:
                    yield values


class _Pages:
    """The whole pages of a file, by their numbers from 1 on."""

    def __init__(self, data: mmap.mmap, size: int) -> None:
        self._data, self._size = data, size
        self._usable = size - data[20]
        self.count = len(data) // size
        self._reads = MOST_READS * self.count

    def _page(self, number: int) -> bytes:
        return self._data[(number - 1) * self._size : number * self._size]

    def free(self) -> set[int]:
        """Numbers of the pages on the list of free ones, as far as that can be followed."""
        free: set[int] = set()
        (trunk,) = struct.unpack(">I", self._data[32:36])
        while 0 < trunk <= self.count and trunk not in free:
            free.add(trunk)
            page = self._page(trunk)
            trunk, leaves = struct.unpack_from(">2I", page)
            leaves = min(leaves, self._usable // 4 - 2)
            free.update(struct.unpack_from(f">{leaves}I", page, 8))
        return free

    def payloads(self, number: int) -> Iterator[bytes]:
        """The payloads of a page's cells; of a page of another kind none."""
        page = self._page(number)
        if page[0] not in (INTERIOR, LEAF):
            return
        begin = 12 if page[0] == INTERIOR else 8
        (cells,) = struct.unpack_from(">H", page, 3)
        if begin + 2 * cells > self._usable:
            return
        for at in struct.unpack_from(f">{cells}H", page, begin):
            if (payload := self._payload(page, at + 4 * (page[0] == INTERIOR))) is not None:
                yield payload

    def _payload(self, page: bytes, at: int) -> bytes | None:
        """The payload of the cell at a place in a page; None if it does not hold, or is not all there."""
        try:
            length, at = _number(page, at)
        except IndexError:
            return None
        if length > len(self._data):
            return None
        most, least = ((self._usable - 12) * share // 255 - 23 for share in (64, 32))
        local = length
        if length > most:
            local = least + (length - least) % (self._usable - 4)
            local = local if local <= most else least
        payload = bytearray(page[at : at + local])
        link = page[at + local : at + local + 4]
        while len(payload) < length:
            following = int.from_bytes(link, "big")
            if not 1 < following <= self.count or not self._reads:
                return None
            self._reads -= 1
            overflow = self._page(following)
            link = overflow[:4]
            payload += overflow[4 : min(self._usable, 4 + length - len(payload))]
        return bytes(payload)


def _number(data: bytes, at: int) -> tuple[int, int]:
    """A number of variable length, and where what follows it begins."""
    value = 0
    for _ in range(8):
        byte = data[at]
        at += 1
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at
    return value << 8 | data[at], at + 1


def _values(payload: bytes) -> tuple[Value, ...]:
    """The values of a record; empty if it is none."""
    try:
        end, at = _number(payload, 0)
        types, values = [], list[Value]()
        while at < end:
            kind, at = _number(payload, at)
            types.append(kind)
    except IndexError:
        return ()
    at = end
    for kind in types:
        size = INTEGERS.get(kind, 8 if kind == 7 else max(kind - 12, 0) // 2)
        field = payload[at : at + size]
        at += size
        if kind in INTEGERS:
            values.append(int.from_bytes(field, "big", signed=True))
        elif kind in (8, 9):
            values.append(kind - 8)
        else:
            values.append(field if kind >= 12 else None)
    return tuple(values) if at == len(payload) else ()
