"""Rows read off the pages of a database: as SQLite reads them, and from files made to take for ever."""

import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.storage import page_scan
from mapweave.storage.page_scan import rows_of_pages

integers = st.integers(-(2**63), 2**63 - 1)
values = st.tuples(integers | st.none(), st.binary(max_size=40), st.integers(0, 9000))


@settings(max_examples=20)
@given(
    st.dictionaries(integers, st.tuples(integers | st.none(), st.binary(max_size=40), st.integers(0, 9000)))
)
def test_rows_are_those_that_sqlite_reads(
    tmp_path_factory: Any, rows: dict[int, tuple[int | None, bytes, int]]
):
    path = tmp_path_factory.mktemp("scan") / "rows.sqlite"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE t (a INTEGER PRIMARY KEY, b INTEGER, c BLOB) WITHOUT ROWID")
        for key, (number, some, more) in rows.items():
            database.execute("INSERT INTO t VALUES (?, ?, ?)", (key, number, some + bytes(more)))
        expected = database.execute("SELECT * FROM t ORDER BY a").fetchall()
    assert sorted(rows_of_pages(path, 3)) == expected


def test_rows_that_all_claim_the_same_pages_cost_no_more_than_the_file_is_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    size, leaves, chain = 512, 50, 1000
    count = 1 + leaves + chain
    length = size * count
    header = bytearray(size)
    header[:18] = b"SQLite format 3\0" + struct.pack(">H", size)
    claimed = bytes((0x80 | length >> 14, 0x80 | length >> 7 & 0x7F, length & 0x7F))
    least = (size - 12) * 32 // 255 - 23
    most = (size - 12) * 64 // 255 - 23
    local = least + (length - least) % (size - 4)
    cell = claimed + bytes(local if local <= most else least) + struct.pack(">I", 2 + leaves)
    leaf = bytearray(size)
    leaf[0], at = page_scan.LEAF, size - len(cell)
    leaf[at:] = cell
    cells = (at - 8) // 2
    leaf[3:5] = struct.pack(">H", cells)
    leaf[8 : 8 + 2 * cells] = struct.pack(">H", at) * cells
    links = [struct.pack(">I", 3 + leaves + k) + bytes(size - 4) for k in range(chain)]
    path = tmp_path / "hostile.sqlite"
    path.write_bytes(bytes(header) + bytes(leaf) * leaves + b"".join(links))
    reads, page = [0], page_scan._Pages._page

    def counted(self: Any, number: int) -> bytes:
        reads[0] += 1
        return page(self, number)

    monkeypatch.setattr(page_scan._Pages, "_page", counted)
    assert list(rows_of_pages(path, 3)) == []
    assert chain < reads[0] <= 5 * count
