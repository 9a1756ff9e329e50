"""How much a store keeps, and what of it later changes have superseded."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any

from mapweave.hybridmap.change import EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import MAX_NUMBER
from mapweave.mapserver.log.entry import Traffic

ROW_BYTES = 100
"""That a change takes beside its message: its key, its columns and its place in the table."""
_OF_NODES = f"kind IN ('{NodePut.__name__}', '{NodeRetired.__name__}')"
_RETIRES = f"kind IN ('{NodeRetired.__name__}', '{EdgeRetired.__name__}')"
_SUPERSEDED = (
    "SELECT sequence, wire_bytes FROM (SELECT sequence, wire_bytes, kind, max(sequence) OVER element AS "
    f"newest, max(CASE WHEN {_RETIRES} THEN sequence ELSE 0 END) OVER element AS retired "
    "FROM change WHERE agent = ? AND epoch = ? "
    f"WINDOW element AS (PARTITION BY number, {_OF_NODES})) AS ranked "
    f"WHERE sequence < retired OR (sequence < newest AND NOT {_RETIRES}) LIMIT ?"
)
"""Of each node and edge its newest change stays, and its last retirement: another server that shares the
store may not have read that yet, and edges of before go with it."""


class SqlSizes(ABC):
    """Counts of what is kept. Tables are as in mapweave.mapserver.log.integrity, marks of values are `?`."""

    def __init__(self) -> None:
        self._traffic_lock = threading.Lock()
        self._counted: dict[tuple[str, int], int] = {}
        """Up to which change of each map, by robot and epoch, `_sums` counts."""
        self._sums: dict[str, tuple[int, int]] = {}
        """Changes and their bytes on the wire, by kind."""

    def landmarks(self, node: NodeId) -> int | None:
        """How many landmarks a node has; None if there is no such node."""
        rows = self._read("SELECT landmarks FROM node WHERE agent = ? AND epoch = ? AND number = ?", node)
        return int(rows[0][0]) if rows else None

    def kept(self, agent: str) -> dict[MapId, tuple[int, int]]:
        """Nodes and landmarks of each map of a robot."""
        query = (
            "SELECT epoch, count(*), CAST(sum(landmarks) AS BIGINT) FROM node WHERE agent = ? GROUP BY epoch"
        )
        return {MapId(agent, epoch): (nodes, total) for epoch, nodes, total in self._read(query, (agent,))}

    def edges(self, agent: str) -> dict[MapId, int]:
        """Edges of each map of a robot; this reads through all of its logs."""
        query = (
            "SELECT epoch, number, kind FROM change WHERE agent = ? AND kind IN (?, ?) "
            "ORDER BY epoch, sequence"
        )
        edges: dict[MapId, set[int]] = {}
        for epoch, number, kind in self._read(query, (agent, EdgePut.__name__, EdgeRetired.__name__)):
            there = edges.setdefault(MapId(agent, epoch), set())
            (there.add if kind == EdgePut.__name__ else there.discard)(number)
        return {map_id: len(there) for map_id, there in edges.items()}

    def stored_bytes(self, map_id: MapId, after: int, last: int) -> int:
        """Bytes that are kept of the changes of a map behind `after`, up to `last`, taken or refused.

        Each counts with its message and `ROW_BYTES`. This reads through that part of the log.
        """
        where = "FROM {} WHERE agent = ? AND epoch = ? AND sequence > ? AND sequence <= ?"
        sizes = {"change": "wire_bytes", "refused": "length(message) + length(reason)"}
        total = 0
        for table, size in sizes.items():
            query = f"SELECT count(*), CAST(coalesce(sum({size}), 0) AS BIGINT) {where.format(table)}"
            ((count, size_of_all),) = self._read(query, (*map_id, after, last))
            total += int(size_of_all) + ROW_BYTES * int(count)
        return total

    def superseded(self, map_id: MapId, most: int) -> list[tuple[int, int]]:
        """Changes of a map that later ones of it supersede: without them its replay is the same map.

        Of each node and edge that was put or retired the newest change stays, and the last retirement. This
        reads through the log.

        Args:
            map_id: of the map.
            most: so many at most.

        Returns:
            Sequence number and bytes of each, as in `stored_bytes`.
        """
        rows = self._read(_SUPERSEDED, (*map_id, most))
        return [(sequence, ROW_BYTES + wire_bytes) for sequence, wire_bytes in rows]

    def drop(self, map_id: MapId, sequences: Sequence[int]) -> None:
        """Delete superseded changes of a map.

        The watermark stays, so the robot does not send again what is deleted.

        Raises:
            InvalidFile: the disk does not take it; nothing is deleted.
        """
        marks = ", ".join("?" * len(sequences))
        query = f"DELETE FROM change WHERE agent = ? AND epoch = ? AND sequence IN ({marks})"
        with self._transaction():
            self._write(query, (*map_id, *sequences))

    def traffic(self, map_id: MapId | None = None) -> Traffic:
        """What a map has cost on the wire, or all maps together if none is named.

        A server asks twice a second, so of all maps only what has come since the last time is read.
        """
        if map_id is None:
            with self._traffic_lock:
                self._count_new_changes()
                sums = dict(self._sums)
            rows = self._read("SELECT count(*) FROM node")
        else:
            whole = (*map_id, 0, MAX_NUMBER)
            sums = {kind: (puts, size) for kind, puts, size in self._wire_bytes([whole])}
            rows = self._read("SELECT count(*) FROM node WHERE agent = ? AND epoch = ?", map_id)
        put, edge = (sums.get(kind.__name__, (0, 0)) for kind in (NodePut, EdgePut))
        return Traffic(int(rows[0][0]), *put, *edge)

    def _count_new_changes(self) -> None:
        counted = self._counted
        grown = [
            (agent, epoch, counted.get((agent, epoch), 0), watermark)
            for agent, epoch, watermark in self._read("SELECT agent, epoch, watermark FROM log")
            if watermark > counted.get((agent, epoch), 0)
        ]
        for kind, puts, size in self._wire_bytes(grown) if grown else ():
            before = self._sums.get(kind, (0, 0))
            self._sums[kind] = before[0] + puts, before[1] + size
        counted |= {(agent, epoch): last for agent, epoch, _, last in grown}

    def _count_again(self) -> None:
        """After changes that were counted are deleted, or others are put among them."""
        with self._traffic_lock:
            self._counted.clear()
            self._sums.clear()

    @abstractmethod
    def _wire_bytes(self, grown: Sequence[tuple[str, int, int, int]]) -> Iterable[tuple[str, int, int]]:
        """Changes and their bytes by kind, of stretches of logs.

        Args:
            grown: agent, epoch, the change before the first one and the last one.
        """

    @abstractmethod
    def _read(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        """The rows of a query, inside a transaction or outside.

        Raises:
            InvalidFile: they cannot be read.
        """

    @abstractmethod
    def _transaction(self) -> AbstractContextManager[None]:
        """All that is written inside is committed at the end, or nothing of it; one thread at a time.

        Raises:
            InvalidFile: it is not committed.
        """

    @abstractmethod
    def _write(self, query: str, values: Sequence[object]) -> None:
        """Inside a transaction."""
