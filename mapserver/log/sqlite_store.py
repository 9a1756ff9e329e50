"""The store in one SQLite file on the server's disk."""

import logging
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.entry import Position
from mapweave.mapserver.log.integrity import SCHEMA, Gap, checksum, insert, repair
from mapweave.mapserver.log.store import ID, LogChanges, News, Store, fresh_id
from mapweave.storage.database import Database
from mapweave.storage.full_disks import logged
from mapweave.wire.log_messages import StoredChange

log = logging.getLogger(__name__)

APPLICATION_ID = 0x4D575354
"""'MWST' in the file's header."""

VERSION = 1
MOST_MAPS = 4096
"""Of which it is remembered how many landmarks each node has."""
ADVICE = (
    "save what can be read with `mapweave map extract FILE -o FOLDER`, then move the file away: robots send "
    "again what they keep"
)


class SqliteStore(Store):
    """All logs in one SQLite file, which belongs to one process."""

    shared = False
    leads = True
    displaced = ""

    def __init__(self, path: Path) -> None:
        """Open the store, or make one. Rows that are damaged are taken out, see `damaged`.

        Raises:
            InvalidFile: damaged as a whole, of another kind, or in use.
        """
        super().__init__()
        self._lock = threading.RLock()
        self._landmarks: dict[MapId, dict[int, int]] = {}
        """By map and number, of all nodes of some maps: each node and edge that comes asks for some."""
        self._database = Database(path, "map store", APPLICATION_ID, VERSION, SCHEMA, repair, ADVICE)
        for gap in self.damaged():
            log.error("%s: %s", path, _words(gap))
        store_id = self.result(ID)
        self.id = int.from_bytes(store_id, "big") if store_id else fresh_id()
        if not store_id:
            try:
                self.put_result(ID, self.id.to_bytes(8, "big"))
            except InvalidFile as error:
                # Such a store cannot be written either, but can be read.
                if not logged(error):
                    log.warning("%s", error)

    def follow(self, changed: Callable[[News], None]) -> None:
        """Nothing: no other server writes to the file."""

    def newest_change(self, map_id: MapId, watermark: int) -> StoredChange | None:
        """See `Store`; None for one that the disk has damaged since the store was opened.

        Its checksum would tell the robot that the robot's own disk was put back, which ends that log.
        """
        query = (
            "SELECT * FROM change WHERE agent = ? AND epoch = ? AND sequence <= ? "
            "ORDER BY sequence DESC LIMIT 1"
        )
        for *values, crc in self._read(query, (*map_id, watermark)):
            if checksum(values) == crc:
                return StoredChange(values[2], zlib.crc32(values[-1]))
        return None

    def landmarks(self, node: NodeId) -> int | None:
        """How many landmarks a node has; None if there is no such node."""
        with self._lock:
            counts = self._landmarks.get(node.map)
            if counts is None:
                query = "SELECT number, landmarks FROM node WHERE agent = ? AND epoch = ?"
                counts = dict(self._read(query, node.map))
                # A change may name maps that are not there: they take no room.
                if counts:
                    if len(self._landmarks) >= MOST_MAPS:
                        del self._landmarks[next(iter(self._landmarks))]
                    self._landmarks[node.map] = counts
            return counts.get(node.number)

    def close(self) -> None:
        """Close the file. Idempotent."""
        with self._lock:
            self._database.close()

    def _read(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        with self._lock, self._database.guard():
            return self._database.connection.execute(query, values).fetchall()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock:
            try:
                with self._database.transaction():
                    yield
            except BaseException:
                self._landmarks.clear()
                raise

    def _begin(self, runs: Sequence[LogChanges]) -> dict[MapId, Position]:
        query = "SELECT log_id, watermark FROM log WHERE agent = ? AND epoch = ?"
        found = ((map_id, self._read(query, map_id)) for map_id in {run.map_id for run in runs})
        return {map_id: Position(int(rows[0][0]), rows[0][1]) for map_id, rows in found if rows}

    def _wire_bytes(self, grown: Sequence[tuple[str, int, int, int]]) -> Iterable[tuple[str, int, int]]:
        query = (
            "SELECT kind, count(*), sum(wire_bytes) FROM change "
            "WHERE agent = ? AND epoch = ? AND sequence > ? AND sequence <= ? GROUP BY kind"
        )
        for stretch in grown:
            yield from self._read(query, stretch)

    def _lock_table(self, table: str) -> None:
        """Nothing: the whole file is this process's."""

    def _write(self, query: str, values: Sequence[object]) -> None:
        self._database.connection.execute(query, values)

    def _delete_nodes(self, map_id: MapId, numbers: Sequence[int]) -> None:
        super()._delete_nodes(map_id, numbers)
        self._landmarks.pop(map_id, None)

    def _put(self, table: str, values: Sequence[Any]) -> None:
        insert(self._database.connection, table, values)
        if table == "node":
            agent, epoch, number, landmarks = values
            if (counts := self._landmarks.get(MapId(agent, epoch))) is not None:
                counts[number] = landmarks


def _words(gap: Gap) -> str:
    changes = f"change {gap.first}" if gap.first == gap.last else f"changes {gap.first} to {gap.last}"
    return f"{changes} of {gap.map}: damaged, and left out until {gap.map.agent} sends them again"
