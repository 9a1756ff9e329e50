"""Salvage of a store that does not open any more."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import MapId
from mapweave.mapserver.log.integrity import checksum
from mapweave.wire.codec import decode_body


@dataclass(frozen=True)
class Salvage:
    """Result of a salvage.

    Attributes:
        maps: the replay of the changes that are good, by their map.
        changes: how many these are.
        damaged: rows with wrong checksums.
        whole: whether all pages could be read.
    """

    maps: dict[MapId, HybridMap]
    changes: int
    damaged: int
    whole: bool


def salvage(path: Path) -> Salvage:
    """Read all undamaged changes; the file is not modified.

    Raises:
        InvalidFile: nothing in it can be read.
    """
    if not path.is_file():
        raise InvalidFile(f"{path}: no such file")
    with tempfile.TemporaryDirectory() as folder:
        # A copy, with what was not yet put into the file itself: SQLite writes into what it reads.
        copy = Path(folder) / "store"
        shutil.copyfile(path, copy)
        beside = path.with_name(path.name + "-wal")
        if beside.is_file():
            shutil.copyfile(beside, copy.with_name("store-wal"))
        connection = sqlite3.connect(copy)
        connection.text_factory = lambda data: data.decode("utf-8", "replace")
        try:
            return _read(connection, path)
        finally:
            connection.close()


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
    return Salvage(maps, len(good), damaged, not error)


def _keep(good: dict[tuple[MapId, int], ChangeBody], values: list[Any]) -> bool:
    agent, epoch, sequence, *_, body = values
    try:
        good[MapId(agent, epoch), sequence] = decode_body(body)
    except InvalidMessage:
        return False
    return True
