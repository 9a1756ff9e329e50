"""Damaged rows of the store are found by their checksums and removed.

A flipped bit costs the row that it hits, not the store: the good rows are copied into a fresh table, and for
each lost change the part of its log that must be pulled from its robot again is recorded. A damaged key is
useless, so the rows before and after it show what is missing.
"""

import logging
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Any, NamedTuple

from mapweave.hybridmap.ids import MapId

log = logging.getLogger(__name__)

SCHEMA = """
CREATE TABLE log (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, log_id TEXT NOT NULL, watermark INTEGER NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (agent, epoch)
) WITHOUT ROWID;
CREATE TABLE change (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL, stamp_ns INTEGER NOT NULL,
    kind TEXT NOT NULL, number INTEGER NOT NULL, wire_bytes INTEGER NOT NULL, body BLOB NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (agent, epoch, sequence)
) WITHOUT ROWID;
CREATE TABLE damaged (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, first INTEGER NOT NULL, last INTEGER NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (agent, epoch, first)
) WITHOUT ROWID;
CREATE TABLE unverified (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, first INTEGER NOT NULL, last INTEGER NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (agent, epoch)
) WITHOUT ROWID;
CREATE TABLE node (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, number INTEGER NOT NULL, landmarks INTEGER NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (agent, epoch, number)
) WITHOUT ROWID;
CREATE TABLE refused (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL, reason TEXT NOT NULL,
    message BLOB NOT NULL, crc INTEGER NOT NULL, PRIMARY KEY (agent, epoch, sequence)
) WITHOUT ROWID;
CREATE TABLE manual_constraint (
    number INTEGER NOT NULL, body BLOB NOT NULL, crc INTEGER NOT NULL, PRIMARY KEY (number)
) WITHOUT ROWID;
CREATE TABLE annotation (
    number INTEGER NOT NULL, body BLOB NOT NULL, crc INTEGER NOT NULL, PRIMARY KEY (number)
) WITHOUT ROWID;
CREATE TABLE result (
    name TEXT NOT NULL, value BLOB NOT NULL, crc INTEGER NOT NULL, PRIMARY KEY (name)
) WITHOUT ROWID
"""
"""The last column of every table is the checksum of the others."""

TABLES = {statement.split()[2]: statement.strip() for statement in SCHEMA.split(";")}


class Gap(NamedTuple):
    """A part of a log, both ends included; some of its changes the robot may have dropped."""

    map: MapId
    first: int
    last: int


def checksum(values: Sequence[object]) -> int:
    """The checksum of the columns of a row."""
    *head, last = values
    crc = zlib.crc32("\0".join(map(str, head)).encode("utf-8", "replace"))
    return zlib.crc32(last if isinstance(last, bytes) else str(last).encode("utf-8", "replace"), crc)


def insert(rows: sqlite3.Connection, table: str, values: Sequence[object]) -> None:
    """Put a row with its checksum into a table, in the place of one with the same key."""
    marks = ", ".join("?" * (len(values) + 1))
    rows.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", (*values, checksum(values)))


def repair(connection: sqlite3.Connection) -> None:
    """Take damaged rows out of all tables, and note which changes are to be pulled again."""
    bad = {table: _count_bad(connection, table) for table in TABLES}
    if not any(bad.values()):
        return
    connection.execute("BEGIN IMMEDIATE")
    try:
        if bad["log"]:
            _rebuild(connection, "log")
        gaps = _gaps(connection) if bad["change"] else []
        for table, count in bad.items():
            if count and table != "log":
                _rebuild(connection, table)
        for gap in gaps:
            insert(connection, "damaged", (*gap.map, gap.first, gap.last))
        if bad["log"]:
            _restart_logs(connection)
        connection.execute("COMMIT")
    except BaseException:
        connection.execute("ROLLBACK")
        raise
    for table in ("manual_constraint", "annotation", "refused", "node", "result", "damaged", "unverified"):
        if bad[table]:
            log.error("the store had %d damaged rows of table %s; they are left out", bad[table], table)


def good_rows(connection: sqlite3.Connection, table: str) -> Iterator[tuple[Any, ...] | None]:
    """The rows of a table in the order in which they lie, without their checksums; None for a damaged one."""
    # Without an order and a condition, which would trust keys that may be damaged.
    for *values, crc in connection.execute(f"SELECT * FROM {table}"):
        yield tuple(values) if checksum(values) == crc else None


def _count_bad(connection: sqlite3.Connection, table: str) -> int:
    return sum(row is None for row in good_rows(connection, table))


def _rebuild(connection: sqlite3.Connection, table: str) -> None:
    """Copy the good rows: where a key is damaged, nothing in the old table can be relied on to be found."""
    connection.execute(TABLES[table].replace(f"TABLE {table}", f"TABLE good_{table}", 1))
    for row in good_rows(connection, table):
        if row is not None:
            insert(connection, f"good_{table}", row)
    connection.execute(f"DROP TABLE {table}")
    connection.execute(f"ALTER TABLE good_{table} RENAME TO {table}")


def _gaps(connection: sqlite3.Connection) -> list[Gap]:
    """What the damaged changes may have been, by the good ones before and behind them."""
    logs = [row for row in good_rows(connection, "log") if row is not None]
    gaps: list[Gap] = []
    before: tuple[Any, ...] | None = None
    damaged = False
    for row in chain(good_rows(connection, "change"), [()]):
        if row is None:
            damaged = True
            continue
        if damaged:
            gaps += _between(logs, before, row[:3] or None)
        before, damaged = row[:3], False
    return gaps


def _between(
    logs: Iterable[tuple[Any, ...]], before: tuple[Any, ...] | None, behind: tuple[Any, ...] | None
) -> Iterator[Gap]:
    """The settled changes of all logs between two keys."""
    for agent, epoch, _, watermark in logs:
        map_id = (agent, epoch)
        if (before is None or before[:2] <= map_id) and (behind is None or map_id <= behind[:2]):
            first = before[2] + 1 if before is not None and before[:2] == map_id else 1
            last = behind[2] - 1 if behind is not None and behind[:2] == map_id else watermark
            if first <= min(last, watermark):
                yield Gap(MapId(*map_id), first, min(last, watermark))


def _restart_logs(connection: sqlite3.Connection) -> None:
    """A map of which it is not known any more how far its log came is pulled from the beginning.

    A retirement behind what is left of the log may be lost with the position, so all of it is unverified.
    """
    query = (
        "SELECT agent, epoch, max(sequence) FROM change GROUP BY agent, epoch "
        "HAVING NOT EXISTS (SELECT 1 FROM log WHERE log.agent = change.agent AND log.epoch = change.epoch)"
    )
    for agent, epoch, last in connection.execute(query).fetchall():
        insert(connection, "log", (agent, epoch, "0", 0))
        insert(connection, "unverified", (agent, epoch, 1, last))
        log.error("the position of %s.%s was damaged; its log is pulled from the beginning", agent, epoch)
