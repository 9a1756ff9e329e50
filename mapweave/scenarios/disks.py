"""What is on the disks after a trial: robots' journals and the server's store, compared byte by byte."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store
from mapweave.wire.codec import encode_body


@dataclass(frozen=True)
class DiskRecord:
    """One robot's maps on the disks.

    Attributes:
        map_bytes: of all its changes as they go over the wire.
        unsaved: nodes and edges of its journal that the server's store lacks or has differently.
        map_hash: SHA-256 over its maps: epoch and every node and edge as it would be sent.
    """

    map_bytes: int
    unsaved: int
    map_hash: str


def read_disks(agents: Path, store: Path, robots: Iterable[str]) -> dict[str, DiskRecord]:
    """Read journals and store; no process may have them open.

    Raises:
        InvalidFile: one is damaged.
    """
    kept = SqliteStore(store)
    try:
        return {robot: _compare(Journal(agents / f"{robot}.sqlite", robot), kept) for robot in robots}
    finally:
        kept.close()


def map_hash(contents: Iterable[tuple[MapId, Iterable[ChangeBody]]]) -> str:
    """SHA-256 over maps, independent of the order of their changes."""
    digest = hashlib.sha256()
    for map_id, changes in sorted(contents, key=lambda item: str(item[0])):
        digest.update(str(map_id).encode())
        for encoded in sorted(map(encode_body, changes)):
            digest.update(len(encoded).to_bytes(4, "little") + encoded)
    return digest.hexdigest()


def _compare(journal: Journal, store: Store) -> DiskRecord:
    size, unsaved, maps = 0, 0, []
    try:
        stored = set(store.maps())
        for map_id in journal.maps():
            own_changes = list(HybridMap(journal.replay(map_id)).contents())
            stored_contents = (change.body for change in store.replay(map_id)) if map_id in stored else ()
            stored_changes = set(map(encode_body, HybridMap(stored_contents).contents()))
            unsaved += sum(encode_body(body) not in stored_changes for body in own_changes)
            size += sum(len(change) for _, change in journal.rows(map_id, 1, journal.head(map_id)))
            maps.append((map_id, own_changes))
        return DiskRecord(size, unsaved, map_hash(maps))
    finally:
        journal.close()
