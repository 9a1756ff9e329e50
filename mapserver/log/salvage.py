"""Salvage of a store that does not open any more."""

import sqlite3
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.entry import words_of
from mapweave.mapserver.log.integrity import checksum
from mapweave.mapserver.log.store import HISTORY, PRUNING, Store
from mapweave.storage.database_reader import reading
from mapweave.wire.codec import decode_body
from mapweave.wire.log_messages import Refusal


@dataclass(frozen=True)
class Salvage:
    """Result of a salvage.

    Attributes:
        maps: the replay of the changes that are good, by their map.
        damaged: rows with wrong checksums.
        whole: whether all pages could be read.
        constraints: the manual constraints that are good, encoded, in order.
        annotations: the annotations that are good, likewise.
        results: the server's own results that are good, by name.
        refused_changes: maps of which a change was refused, and why the first one was.
    """

    maps: dict[MapId, HybridMap]
    damaged: int
    whole: bool
    constraints: tuple[bytes, ...]
    annotations: tuple[bytes, ...]
    results: dict[str, bytes]
    refused_changes: dict[MapId, str]


def salvage(path: Path) -> Salvage:
    """Read all undamaged changes; the file is not modified.

    Raises:
        InvalidFile: nothing in it can be read, or a server uses it.
    """
    with reading(path, "map store") as connection:
        try:
            connection.execute("SELECT 1 FROM sqlite_master").fetchone()
        except sqlite3.Error:
            # The description of one table is damaged: with this SQLite reads the others all the same.
            connection.execute("PRAGMA writable_schema=ON")
            return replace(_read(connection, path), whole=False)
        return _read(connection, path)


def all_of(store: Store) -> Salvage:
    """The same of a store that is open."""
    maps: dict[MapId, HybridMap] = {}
    for map_id in store.maps():
        for change in store.replay(map_id):
            maps.setdefault(map_id, HybridMap()).apply(change.body)
    # Last: what is pruned meanwhile is there twice rather than not at all.
    results = {name: store.result(name) for name in (HISTORY, PRUNING)}
    return Salvage(
        maps, 0, True, tuple(store.constraints()), tuple(store.annotations()),
        {name: value for name, value in results.items() if value is not None},
        {m: words_of(refusal) for m in store.maps() for refusal in store.refusals(m)[:1]},
    )  # fmt: skip


def _read(connection: sqlite3.Connection, path: Path) -> Salvage:
    good: dict[tuple[MapId, int], ChangeBody] = {}
    damaged = 0
    error = ""
    # From both ends: a page that cannot be read stops each of them.
    for order in ("", "ORDER BY agent DESC, epoch DESC, sequence DESC"):
        damaged = 0
        try:
            for *values, crc in connection.execute(f"SELECT * FROM change {order}"):
                if checksum(values) != crc or not _keep(good, values):
                    damaged += 1
        except sqlite3.Error as stopped:
            error = str(stopped)
        else:
            error = ""
            break
    if error and not good:
        raise InvalidFile(f"{path}: nothing can be read ({error})")
    maps: dict[MapId, HybridMap] = {}
    for (map_id, _), body in sorted(good.items(), key=lambda item: item[0]):
        maps.setdefault(map_id, HybridMap()).apply(body)
    constraints, constraints_whole = _good(connection, "manual_constraint")
    annotations, annotations_whole = _good(connection, "annotation")
    results, results_whole = _good(connection, "result")
    refused, refused_whole = _good(connection, "refused")
    refused_changes: dict[MapId, str] = {}
    for agent, epoch, sequence, reason, _ in refused:
        refused_changes.setdefault(MapId(agent, epoch), words_of(Refusal(sequence, reason)))
    return Salvage(
        maps, damaged,
        not error and constraints_whole and annotations_whole and results_whole and refused_whole,
        tuple(bytes(body) for _, body in constraints), tuple(bytes(body) for _, body in annotations),
        {str(name): bytes(value) for name, value in results},
        refused_changes,
    )  # fmt: skip


def _good(connection: sqlite3.Connection, table: str) -> tuple[list[list[Any]], bool]:
    """Undamaged rows of a table, and whether all could be read."""
    rows: list[list[Any]] = []
    try:
        for *values, crc in connection.execute(f"SELECT * FROM {table} ORDER BY 1"):
            if checksum(values) == crc:
                rows.append(values)
    except sqlite3.Error:
        return rows, False
    return rows, True


def _keep(good: dict[tuple[MapId, int], ChangeBody], values: list[Any]) -> bool:
    agent, epoch, sequence, *_, body = values
    try:
        good[MapId(agent, epoch), sequence] = decode_body(body)
    except InvalidMessage:
        return False
    return True
