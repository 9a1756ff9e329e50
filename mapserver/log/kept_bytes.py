"""How many bytes the store keeps of one robot, and when it is worth deleting what later changes supersede.

A robot may put the same node again and again, and each time is a row. A map is compacted when as much has
come as was left the last time, and `LEAST_GROWN`: so it is at most about twice as large as what it needs, or
that much larger, and reading it through costs a fixed share of what the robot has sent. Of a large map some
is deleted with each run of changes that comes, so that other robots do not wait.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sql_sizes import ROW_BYTES
from mapweave.mapserver.log.store import PRUNING_MARK, Store

LEAST_GROWN = 2**22
"""Bytes of a map that must have come before it is compacted."""
AT_ONCE = 512
"""Changes that are deleted with a run of changes that comes: more than its own, in some 40 ms."""
MOST_FOUND = 100_000
"""Superseded changes that are found at once, and kept in memory until they are deleted."""


@dataclass
class _Kept:
    """What is kept of one map.

    Attributes:
        bytes: that are kept; changes that were refused count with all of their message until it is compacted.
        counted: up to which change of its log.
        left: bytes that were not superseded when it was read through; 0: that was not yet, or not to its end.
        superseded: changes that are to be deleted, with their bytes.
    """

    bytes: int = 0
    counted: int = 0
    left: int = 0
    superseded: list[tuple[int, int]] = field(default_factory=list)


class KeptBytes:
    """How many bytes of one robot's maps the store keeps."""

    def __init__(self, agent: str, store: Store) -> None:
        self._agent, self._store = agent, store
        self._maps: dict[MapId, _Kept] = {}
        self._behind: set[MapId] | None = None
        """Maps of which another server has taken changes; None: nothing has been read."""
        self._mark: bytes | None = None
        """Of what was pruned when they were read."""

    def grown(self, map_id: MapId) -> None:
        """Another server has taken changes of a map."""
        if self._behind is not None:
            self._behind.add(map_id)

    def read(self) -> None:
        """Count what came since, by this process or another; all of it if some was pruned since.

        Raises:
            InvalidFile: the store cannot be read.
        """
        mark = self._store.result(PRUNING_MARK)
        if self._behind is None or mark != self._mark:
            self._maps, self._behind = {}, set(self._store.maps(self._agent))
            self._mark = mark
        while self._behind:
            map_id = next(iter(self._behind))
            kept = self._maps.setdefault(map_id, _Kept())
            last = self._store.watermark(map_id)
            kept.bytes += self._store.stored_bytes(map_id, kept.counted, last)
            kept.counted = max(kept.counted, last)
            self._behind.discard(map_id)

    def added_by(self, map_id: MapId, entry: ReceivedChange) -> int:
        """Bytes that a change adds to what is counted; 0 if it is counted."""
        kept = self._maps.get(map_id)
        return _size(entry) if kept is None or entry.sequence > kept.counted else 0

    def add(self, map_id: MapId, entry: ReceivedChange) -> None:
        """Count a change that will be stored."""
        kept = self._maps.setdefault(map_id, _Kept())
        kept.bytes += self.added_by(map_id, entry)
        kept.counted = max(kept.counted, entry.sequence)

    def compact(self, map_id: MapId, coming: Sequence[ReceivedChange]) -> None:
        """Delete some of what is superseded in a map; look for it first if the map has grown by enough.

        Args:
            map_id: of the map.
            coming: its next changes, which are not stored yet.

        Raises:
            InvalidFile: the store cannot be read, or does not take it.
        """
        kept = self._maps.get(map_id)
        if kept is None:
            return
        if not kept.superseded:
            grown = kept.bytes + sum(map(_size, coming)) - kept.left
            if grown < max(LEAST_GROWN, kept.left):
                return
            kept.counted = self._store.watermark(map_id)
            kept.bytes = self._store.stored_bytes(map_id, 0, kept.counted)
            kept.superseded = self._store.superseded(map_id, MOST_FOUND)
            found = sum(size for _, size in kept.superseded)
            kept.left = kept.bytes - found if len(kept.superseded) < MOST_FOUND else 0
        if kept.superseded:
            some = kept.superseded[-AT_ONCE:]
            self._store.drop(map_id, [sequence for sequence, _ in some])
            del kept.superseded[-AT_ONCE:]
            kept.bytes -= sum(size for _, size in some)

    def total(self, without: Collection[MapId]) -> int:
        """Bytes of all maps but these."""
        return sum(kept.bytes for map_id, kept in self._maps.items() if map_id not in without)


def _size(entry: ReceivedChange) -> int:
    """Bytes that a change takes in the store."""
    return ROW_BYTES + len(entry.message)
