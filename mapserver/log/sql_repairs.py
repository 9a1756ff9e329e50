"""Logs of which a store has lost a part: what is damaged, what is restored, what has to be verified."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

from mapweave.hybridmap.change import Change, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.integrity import Gap
from mapweave.mapserver.log.sql_sizes import SqlSizes
from mapweave.wire.codec import element_of
from mapweave.wire.log_messages import Refusal

log = logging.getLogger(__name__)

RETIREMENTS: dict[str, Callable[[NodeId], NodeRetired | EdgeRetired]] = {
    NodePut.__name__: NodeRetired,
    EdgePut.__name__: EdgeRetired,
}
"""By the kind of change that they undo."""
PRUNED_AT_ONCE = 256
"""Elements of one map: a log is read through once for so many."""


class SqlRepairs(SqlSizes):
    """The part of `Store` for logs that are not whole."""

    def damaged(self, map_id: MapId | None = None) -> list[Gap]:
        """Changes that were found damaged and are not restored yet, of one map or of all."""
        query = (
            "SELECT agent, epoch, first, last FROM damaged "
            "WHERE CAST(? AS TEXT) IS NULL OR (agent = ? AND epoch = ?) ORDER BY agent, epoch, first"
        )
        agent, epoch = map_id or (None, None)
        rows = self._read(query, (agent, agent, epoch))
        return [Gap(MapId(agent, epoch), first, last) for agent, epoch, first, last in rows]

    def restore(
        self, map_id: MapId, first: int, covered: int, entries: Sequence[ReceivedChange]
    ) -> Iterator[Change]:
        """Put changes that were damaged in their places again, as the robot's log has them.

        Where the robot has dropped some of them, what comes before is unverified: a retirement may be lost.

        Args:
            map_id: whose log.
            first: of a damaged part.
            covered: the robot has nothing else up to here.
            entries: of this part.

        Returns:
            What makes the map whole in the order of its log: the restored changes, and those behind them if
            one of these may undo a restored one.

        Raises:
            InvalidFile: the disk does not take it; nothing is restored.
        """
        changes: list[Change] = []
        refusals: list[Refusal] = []
        with self._transaction():
            for gap in self.damaged(map_id):
                if gap.first <= first <= gap.last:
                    self._write(
                        "DELETE FROM damaged WHERE agent = ? AND epoch = ? AND first = ?",
                        (*map_id, gap.first),
                    )
                    if gap.first < first:
                        self._put("damaged", (*map_id, gap.first, first - 1))
                    if covered < gap.last:
                        self._put("damaged", (*map_id, covered + 1, gap.last))
            for entry in entries:
                self._take(map_id, entry, changes, refusals, restored=True)
            if len(entries) <= covered - first and first > 1:
                before = self.unverified(map_id)
                self._put("unverified", (*map_id, 1, max(first - 1, before.last if before else 0)))
        self._count_again()
        for refusal in refusals:
            log.warning("refused %s %d: %s", map_id, refusal.sequence, refusal.reason)
        if any(self._may_undo(change) for change in changes):
            return self.replay(map_id, changes[0].sequence - 1)
        return iter(changes)

    def unverified(self, map_id: MapId) -> Gap | None:
        """Stored changes that a lost one may have undone; None if there are none, see `verify`."""
        rows = self._read("SELECT first, last FROM unverified WHERE agent = ? AND epoch = ?", map_id)
        return Gap(map_id, *rows[0]) if rows else None

    def doubt(self, map_id: MapId, acknowledged: int) -> None:
        """Have all changes of a log verified if the store once had more of it: it is of a copy of before.

        What was retired meanwhile its robot may have dropped, as soon as it was acknowledged.

        Args:
            map_id: whose log.
            acknowledged: so much of it the robot knows to have been acknowledged.

        Raises:
            InvalidFile: the disk does not take it.
        """
        with self._transaction():
            watermark = self.watermark(map_id)
            if 0 < watermark < acknowledged:
                before = self.unverified(map_id)
                self._put("unverified", (*map_id, 1, max(watermark, before.last if before else 0)))

    def verify(self, map_id: MapId, first: int, covered: int, kept: Collection[int]) -> list[Change]:
        """Delete unverified changes that the robot has dropped, since others undid them.

        Args:
            map_id: whose log.
            first: of the unverified changes.
            covered: the robot has nothing else up to here.
            kept: which of them the robot has.

        Returns:
            The retirement of each node and edge that no stored change puts now.

        Raises:
            InvalidFile: the disk does not take it; nothing is deleted.
        """
        there = (
            "SELECT sequence, stamp_ns, kind, number FROM change "
            "WHERE agent = ? AND epoch = ? AND sequence BETWEEN ? AND ? ORDER BY sequence"
        )
        put = "SELECT 1 FROM change WHERE agent = ? AND epoch = ? AND kind = ? AND number = ? LIMIT 1"
        retired: dict[tuple[str, int], Change] = {}
        with self._transaction():
            dropped = [row for row in self._read(there, (*map_id, first, covered)) if row[0] not in kept]
            for sequence, *_ in dropped:
                self._write(
                    "DELETE FROM change WHERE agent = ? AND epoch = ? AND sequence = ?", (*map_id, sequence)
                )
            for sequence, stamp_ns, kind, number in dropped:
                if kind in RETIREMENTS and not self._read(put, (*map_id, kind, number)):
                    body = RETIREMENTS[kind](NodeId(*map_id, number))
                    retired[kind, number] = Change(map_id, sequence, stamp_ns, body)
            gone = [NodeId(*map_id, number) for kind, number in retired if kind == NodePut.__name__]
            for _, some in numbers_of(gone):
                self._delete_nodes(map_id, some)
            unverified = self.unverified(map_id)
            self._write("DELETE FROM unverified WHERE agent = ? AND epoch = ?", map_id)
            if unverified is not None and covered < unverified.last:
                self._put("unverified", (*map_id, covered + 1, unverified.last))
        self._count_again()
        return list(retired.values())

    def _may_undo(self, change: Change) -> bool:
        """Whether the log goes on behind a change with something that depends on its place in the order."""
        if not isinstance(change.body, NodePut | EdgePut):
            return True
        query = (
            "SELECT 1 FROM change WHERE agent = ? AND epoch = ? AND sequence > ? "
            "AND (number = ? OR kind IN (?, ?)) LIMIT 1"
        )
        retired = (NodeRetired.__name__, EdgeRetired.__name__)
        number = element_of(change.body).number
        return bool(self._read(query, (*change.map, change.sequence, number, *retired)))

    def _delete_nodes(self, map_id: MapId, numbers: Sequence[int]) -> None:
        """Of one map, no more than `numbers_of` gives at once."""
        self._write(
            f"DELETE FROM node WHERE agent = ? AND epoch = ? AND number IN ({marks_of(numbers)})",
            (*map_id, *numbers),
        )

    @abstractmethod
    def replay(self, map_id: MapId, last: int = 0) -> Iterator[Change]:
        """See `Store`."""

    @abstractmethod
    def watermark(self, map_id: MapId) -> int:
        """See `Store`."""

    @abstractmethod
    def _take(
        self,
        map_id: MapId,
        entry: ReceivedChange,
        changes: list[Change],
        refusals: list[Refusal],
        restored: bool = False,
    ) -> None:
        """See `Store`."""

    @abstractmethod
    def _put(self, table: str, values: Sequence[object]) -> None:
        """Inside a transaction: put a row into a table, in the place of one with the same key."""


def marks_of(values: Sequence[object]) -> str:
    """The marks of values in a query."""
    return ", ".join("?" * len(values))


def numbers_of(elements: Iterable[NodeId]) -> list[tuple[MapId, Sequence[int]]]:
    """The numbers of elements by their maps, so many at once."""
    by_map: dict[MapId, list[int]] = {}
    for element in sorted(elements):
        by_map.setdefault(element.map, []).append(element.number)
    return [
        (map_id, numbers[first : first + PRUNED_AT_ONCE])
        for map_id, numbers in by_map.items()
        for first in range(0, len(numbers), PRUNED_AT_ONCE)
    ]
