"""What can still be read of a journal, also of one that no agent can open any more."""

import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, cast

from mapweave.agent.replication.journal import body_of, entry_of, key_holds
from mapweave.agent.replication.log_entry import LogEntry
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId, check_name
from mapweave.storage.database_reader import cut_off, reading
from mapweave.storage.page_scan import rows_of_pages
from mapweave.storage.write_ahead_log import lost_commits
from mapweave.wire.codec import element_of
from mapweave.wire.keys import check_epoch

MOST_LOOKUPS = 1_000_000
"""Changes that are looked up one by one, some ten seconds: a damaged number may be any."""
COLUMNS = "SELECT epoch, sequence, element, put, stamp_ns, body, crc FROM change"
COLUMN_COUNT = 7

Row = tuple[int, int, int, int, int, bytes, int]


@dataclass(frozen=True)
class SalvagedJournal:
    """Result of a salvage.

    Attributes:
        maps: what is left of each map, oldest first.
        whole: whether all pages and commits could be read.
    """

    maps: Mapping[MapId, RetainedMap]
    whole: bool


def salvage(path: Path) -> SalvagedJournal:
    """Read all undamaged changes; the file is not modified.

    Raises:
        InvalidFile: nothing in it can be read, or an agent uses it.
    """
    with reading(path, "agent journal") as connection:
        if _read(connection, "SELECT 1 FROM sqlite_master")[1]:
            # The description of one table is damaged: with this SQLite reads the others all the same.
            connection.execute("PRAGMA writable_schema=ON")
        owners, owner_error = _read(connection, "SELECT agent FROM owner")
        maps, maps_error = _read(connection, "SELECT epoch FROM map ORDER BY epoch")
        rows, rows_error = _changes(connection, [epoch for (epoch,) in maps if _is_epoch(epoch)])
    error = owner_error or maps_error or rows_error
    if rows_error:
        rows = _of_pages(path) | rows
    error = error and (cut_off(path) or error)
    agent = _agent(rows.values(), owners)
    if not agent:
        raise InvalidFile(f"{path}: nothing can be read ({error or 'this journal has no owner'})")
    epochs = {epoch for (epoch,) in maps if _is_epoch(epoch)} | {epoch for epoch, _ in rows}
    kept = {}
    for map_id in (MapId(agent, epoch) for epoch in sorted(epochs)):
        kept[map_id] = RetainedMap.of_entries(map_id, _entries(map_id, rows))
    return SalvagedJournal(kept, not (error or lost_commits(path)))


def _read(connection: sqlite3.Connection, query: str, *values: object) -> tuple[list[Any], str]:
    """The rows before the first page that cannot be read, and why that is so; empty if all could be read."""
    rows: list[Any] = []
    try:
        for row in connection.execute(query, values):
            rows.append(row)  # noqa: PERF402 - an error ends the loop, and what came before it counts
    except (sqlite3.Error, UnicodeDecodeError) as error:
        # SQLite quotes a damaged schema in its error, which then is no text, or has line breaks.
        return rows, " ".join(str(error).split())
    return rows, ""


def _changes(connection: sqlite3.Connection, epochs: Iterable[int]) -> tuple[dict[tuple[int, int], Row], str]:
    """Rows that have the types of the schema, by epoch and sequence; and why some cannot be read.

    Args:
        connection: to the journal.
        epochs: of maps that are known otherwise.
    """
    found, error = _read(connection, f"{COLUMNS} ORDER BY epoch, sequence")
    rows = _by_number(found)
    if not error:
        return rows, ""
    # A page that cannot be read stops a scan from either end: each map is scanned from both of its ends.
    rows |= _by_number(_read(connection, f"{COLUMNS} ORDER BY epoch DESC, sequence DESC")[0])
    for epoch in {*epochs, *(epoch for epoch, _ in rows)}:
        for order in ("ASC", "DESC"):
            query = f"{COLUMNS} WHERE epoch = ? ORDER BY sequence {order}"
            rows |= _by_number(_read(connection, query, epoch)[0])
    heads: dict[int, int] = {}
    for epoch, sequence in rows:
        heads[epoch] = max(heads.get(epoch, 0), sequence)
    # What lies between is looked up one by one, the shortest map first: a damaged head is most probably long.
    missing = (
        (epoch, sequence)
        for epoch, head in sorted(heads.items(), key=lambda item: item[1])
        for sequence in range(1, head)
        if (epoch, sequence) not in rows
    )
    query = f"{COLUMNS} WHERE epoch = ? AND sequence = ?"
    for number in islice(missing, MOST_LOOKUPS):
        rows |= _by_number(_read(connection, query, *number)[0])
    return rows, error


def _of_pages(path: Path) -> dict[tuple[int, int], Row]:
    """Changes that are whole in pages to which no others lead any more."""
    found = (cast(Row, row) for row in rows_of_pages(path, COLUMN_COUNT) if _is_row(row))
    return _by_number(row for row in found if key_holds(row[:5], row[6]) and body_of(row[5], row[6]))


def _by_number(found: Iterable[Row]) -> dict[tuple[int, int], Row]:
    return {(row[0], row[1]): row for row in found if _is_row(row)}


def _is_row(row: tuple[Any, ...]) -> bool:
    epoch, *numbers, body, crc = row
    return _is_epoch(epoch) and all(isinstance(n, int) for n in (*numbers, crc)) and isinstance(body, bytes)


def _is_epoch(epoch: object) -> bool:
    try:
        return isinstance(epoch, int) and check_epoch(epoch) == epoch
    except InvalidValue:
        return False


def _agent(rows: Iterable[Row], owners: Iterable[tuple[Any]]) -> str:
    """Whose journal it is: by its changes, which have checksums, else by its table `owner`; or empty."""
    for *_, encoded, crc in rows:
        if (body := body_of(encoded, crc)) is not None:
            return element_of(body).agent
    for (owner,) in owners:
        try:
            return check_name(owner)
        except InvalidValue:
            continue
    return ""


def _entries(map_id: MapId, rows: Mapping[tuple[int, int], Row]) -> Iterator[LogEntry]:
    for (epoch, sequence), (*key, encoded, crc) in sorted(rows.items()):
        if epoch != map_id.epoch:
            continue
        if key_holds(key, crc):
            yield entry_of(map_id, sequence, key[2], key[3], encoded, crc)
        else:
            # What it is about is not known.
            yield LogEntry(sequence, NodeId(*map_id, 0), True, None)
