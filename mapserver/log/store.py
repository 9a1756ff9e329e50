"""The server's disk: every agent's log, exactly once and in order, and the server's own results."""

from __future__ import annotations

import logging
import secrets
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mapweave.hybridmap.annotation import MAX_ANNOTATIONS
from mapweave.hybridmap.change import Change, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.node import EdgeId, MapId, NodeId
from mapweave.mapserver.log.entry import Applied, Entry, Position, Traffic
from mapweave.mapserver.log.integrity import SCHEMA, Gap, insert, repair
from mapweave.storage.database import Database
from mapweave.wire.codec import decode_body, element_of, unwrap_body
from mapweave.wire.log_messages import Refusal

log = logging.getLogger(__name__)

APPLICATION_ID = 0x4D575354
"""'MWST' in the file's header."""

VERSION = 2
ID = "store id"
"""Among the results."""
HISTORY = "history"
"""Among the results, too: see mapweave.mapserver.map_history."""
READ_AT_ONCE = 256
ADVICE = (
    "save what can be read with `mapweave map extract FILE -o FOLDER`, then move the file away: robots send "
    "again what they keep"
)
MOST_REFUSED_KEPT = 100
"""Refused changes of a map of which the bytes are kept; of further ones only the reason."""
MAX_CONSTRAINTS = 10_000
"""Made by hand, one by one."""


class Store:
    """All logs in one SQLite file. Its methods may be called from any thread.

    Attributes:
        id: random, drawn when the store was made, see mapweave.wire.log_messages.Ack.
    """

    def __init__(self, path: Path) -> None:
        """Open the store, or make one. Rows that are damaged are taken out, see `damaged`.

        Raises:
            InvalidFile: damaged as a whole, of another kind, or in use.
        """
        self._lock = threading.RLock()
        self._database = Database(path, "map store", APPLICATION_ID, VERSION, SCHEMA, repair, ADVICE)
        for gap in self.damaged():
            log.error("%s: %s", path, _words(gap))
        store_id = self.result(ID)
        self.id = int.from_bytes(store_id, "big") if store_id else secrets.randbits(62) + 1
        if not store_id:
            try:
                self.put_result(ID, self.id.to_bytes(8, "big"))
            except InvalidFile as error:
                # Such a store cannot be written either, but can be read.
                log.warning("%s", error)

    def maps(self) -> list[MapId]:
        """All maps of which something is known."""
        return [MapId(*row) for row in self._read("SELECT agent, epoch FROM log ORDER BY agent, epoch")]

    def positions(self) -> dict[MapId, Position]:
        """Which log is kept of each map, and how far it is settled."""
        rows = self._read("SELECT agent, epoch, log_id, watermark FROM log")
        return {MapId(agent, epoch): Position(int(log_id), mark) for agent, epoch, log_id, mark in rows}

    def present(self) -> set[NodeId]:
        """All nodes that are not retired, without reading their contents."""
        query = (
            "SELECT agent, epoch, number, kind FROM change WHERE kind IN (?, ?) "
            "ORDER BY agent, epoch, sequence"
        )
        nodes: set[NodeId] = set()
        for *element, kind in self._read(query, (NodePut.__name__, NodeRetired.__name__)):
            (nodes.add if kind == NodePut.__name__ else nodes.discard)(NodeId(*element))
        return nodes

    def watermark(self, map_id: MapId) -> int:
        """Up to which change the log is settled, 0 without a log."""
        rows = self._read("SELECT watermark FROM log WHERE agent = ? AND epoch = ?", map_id)
        return int(rows[0][0]) if rows else 0

    def log_id(self, map_id: MapId) -> int | None:
        """Id of the log of this name, None without one."""
        rows = self._read("SELECT log_id FROM log WHERE agent = ? AND epoch = ?", map_id)
        return int(rows[0][0]) if rows else None

    def apply(
        self, map_id: MapId, log_id: int, entries: Sequence[Entry], covered: int | None = None
    ) -> Applied:
        """Take the next changes of a log, in one transaction with its watermark.

        Duplicates are left out. A refused change is kept aside with its reason and the log goes on
        behind it: one bad change must not hold up a map for ever.

        Args:
            map_id: whose log.
            log_id: which.
            entries: in order of their sequence numbers.
            covered: the agent has nothing else up to here. Without it, entries behind a gap are left out.

        Returns:
            What is new.

        Raises:
            InvalidValue: another log goes by this name.
            InvalidFile: the disk does not take it; nothing is applied.
        """
        changes: list[Change] = []
        refusals: list[Refusal] = []
        with self._lock, self._database.transaction() as rows:
            stored_id = self.log_id(map_id)
            if stored_id is not None and stored_id != log_id and self.watermark(map_id) > 0:
                raise InvalidValue(f"another log goes by the name {map_id}: begin a fresh map")
            watermark = self.watermark(map_id)
            for entry in entries:
                if entry.sequence <= watermark:
                    continue
                if entry.sequence > watermark + 1 and covered is None:
                    break
                self._take(rows, map_id, entry, changes, refusals)
                watermark = entry.sequence
            watermark = max(watermark, covered or 0)
            insert(rows, "log", (*map_id, str(log_id), watermark))
        return Applied(tuple(changes), tuple(refusals), watermark)

    def prune(
        self, nodes: Iterable[NodeId], edges: Iterable[EdgeId], results: Mapping[str, bytes]
    ) -> None:
        """Delete the changes of nodes and edges for good, in one transaction with results that stand for them.

        The logs' watermarks stay, so robots do not send them again.

        Args:
            nodes: that have left the map.
            edges: likewise.
            results: by their names, see `put_result`.

        Raises:
            InvalidFile: the disk does not take it; nothing is pruned.
        """
        nodes = tuple(nodes)
        with self._lock, self._database.transaction() as rows:
            for elements, names in ((nodes, (NodePut, NodeRetired)), (tuple(edges), (EdgePut, EdgeRetired))):
                kinds = [kind.__name__ for kind in names]
                rows.executemany(
                    "DELETE FROM change WHERE agent = ? AND epoch = ? AND number = ? AND kind IN (?, ?)",
                    ((*element, *kinds) for element in elements),
                )
            rows.executemany("DELETE FROM node WHERE agent = ? AND epoch = ? AND number = ?", nodes)
            for name, value in results.items():
                insert(rows, "result", (name, value))

    def replay(self, map_id: MapId, last: int = 0) -> Iterator[Change]:
        """Every change behind `last` that was taken, in order.

        Those that cannot be read, or are out of bounds since they were taken, are left out.
        """
        query = (
            "SELECT sequence, stamp_ns, body FROM change "
            "WHERE agent = ? AND epoch = ? AND sequence > ? ORDER BY sequence LIMIT ?"
        )
        while rows := self._read(query, (*map_id, last, READ_AT_ONCE)):
            for last, stamp_ns, body in rows:
                try:
                    yield Change(map_id, last, stamp_ns, decode_body(body))
                except InvalidMessage as error:
                    log.error("change %d of %s cannot be read (%s); it is left out", last, map_id, error)

    def damaged(self, map_id: MapId | None = None) -> list[Gap]:
        """Changes that were found damaged and are not restored yet, of one map or of all."""
        query = (
            "SELECT agent, epoch, first, last FROM damaged WHERE ? IS NULL OR (agent = ? AND epoch = ?) "
            "ORDER BY agent, epoch, first"
        )
        agent, epoch = map_id or (None, None)
        rows = self._read(query, (agent, agent, epoch))
        return [Gap(MapId(agent, epoch), first, last) for agent, epoch, first, last in rows]

    def restore(self, map_id: MapId, first: int, covered: int, entries: Sequence[Entry]) -> Iterator[Change]:
        """Put changes that were damaged in their places again, as the robot's log has them.

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
        with self._lock, self._database.transaction() as rows:
            for gap in self.damaged(map_id):
                if gap.first <= first <= gap.last:
                    rows.execute(
                        "DELETE FROM damaged WHERE agent = ? AND epoch = ? AND first = ?",
                        (*map_id, gap.first),
                    )
                    if gap.first < first:
                        insert(rows, "damaged", (*map_id, gap.first, first - 1))
                    if covered < gap.last:
                        insert(rows, "damaged", (*map_id, covered + 1, gap.last))
            for entry in entries:
                self._take(rows, map_id, entry, changes, refusals)
        for refusal in refusals:
            log.warning("refused %s %d: %s", map_id, refusal.sequence, refusal.reason)
        if any(self._may_undo(change) for change in changes):
            return self.replay(map_id, changes[0].sequence - 1)
        return iter(changes)

    def landmarks(self, node: NodeId) -> int | None:
        """How many landmarks a node has; None if there is no such node."""
        rows = self._read("SELECT landmarks FROM node WHERE agent = ? AND epoch = ? AND number = ?", node)
        return int(rows[0][0]) if rows else None

    def kept(self, agent: str) -> dict[MapId, tuple[int, int]]:
        """Nodes and landmarks of each map of a robot."""
        query = "SELECT epoch, count(*), sum(landmarks) FROM node WHERE agent = ? GROUP BY epoch"
        return {MapId(agent, epoch): (nodes, total) for epoch, nodes, total in self._read(query, (agent,))}

    def refusals(self, map_id: MapId, newest: int = 16) -> list[Refusal]:
        """The newest changes of a map that were refused, in order."""
        query = (
            "SELECT sequence, reason FROM refused WHERE agent = ? AND epoch = ? "
            "ORDER BY sequence DESC LIMIT ?"
        )
        return [Refusal(*row) for row in reversed(self._read(query, (*map_id, newest)))]

    def refused(self) -> int:
        """How many changes of any map were refused."""
        return int(self._read("SELECT count(*) FROM refused")[0][0])

    def traffic(self, map_id: MapId | None = None) -> Traffic:
        """What a map has cost on the wire, or all maps together if none is named."""
        query = (
            "SELECT count(*), coalesce(sum(wire_bytes), 0) FROM change "
            "WHERE kind = ? AND (? IS NULL OR (agent = ? AND epoch = ?))"
        )
        agent, epoch = map_id or (None, None)
        node_puts, node_bytes = self._read(query, (NodePut.__name__, agent, agent, epoch))[0]
        edge_puts, edge_bytes = self._read(query, (EdgePut.__name__, agent, agent, epoch))[0]
        count = "SELECT count(*) FROM node WHERE ? IS NULL OR (agent = ? AND epoch = ?)"
        nodes = self._read(count, (agent, agent, epoch))[0][0]
        return Traffic(nodes, node_puts, node_bytes, edge_puts, edge_bytes)

    def constraints(self) -> list[bytes]:
        """The manual constraints, in order."""
        return self._record("manual_constraint")

    def add_constraint(self, body: bytes) -> None:
        """Add a manual constraint.

        Raises:
            InvalidValue: there are too many.
            InvalidFile: the disk does not take it.
        """
        self._add_to_record("manual_constraint", body, MAX_CONSTRAINTS)

    def annotations(self) -> list[bytes]:
        """The annotations, in order."""
        return self._record("annotation")

    def add_annotation(self, body: bytes) -> None:
        """Add an annotation; see `add_constraint`."""
        self._add_to_record("annotation", body, MAX_ANNOTATIONS)

    def put_result(self, name: str, value: bytes) -> None:
        """Store another result of the server.

        Raises:
            InvalidFile: the disk does not take it.
        """
        with self._lock, self._database.transaction() as rows:
            insert(rows, "result", (name, value))

    def result(self, name: str) -> bytes | None:
        """The result of this name."""
        rows = self._read("SELECT value FROM result WHERE name = ?", (name,))
        return bytes(rows[0][0]) if rows else None

    def close(self) -> None:
        """Close the file. Idempotent."""
        with self._lock:
            self._database.close()

    def _record(self, table: str) -> list[bytes]:
        return [bytes(body) for (body,) in self._read(f"SELECT body FROM {table} ORDER BY number")]

    def _add_to_record(self, table: str, body: bytes, most: int) -> None:
        with self._lock, self._database.transaction() as rows:
            count, newest = rows.execute(f"SELECT count(*), coalesce(max(number), 0) FROM {table}").fetchone()
            if count >= most:
                raise InvalidValue(f"the record of {table.replace('_', ' ')}s is full: {most}")
            insert(rows, table, (newest + 1, body))

    def _take(
        self, rows: Any, map_id: MapId, entry: Entry, changes: list[Change], refusals: list[Refusal]
    ) -> None:
        """Store a change, or store it aside with the reason."""
        reason = entry.change if isinstance(entry.change, str) else self._objection(entry.change)
        if isinstance(entry.change, str) or reason:
            refusals.append(Refusal(entry.sequence, reason))
            count = "SELECT count(*) FROM refused WHERE agent = ? AND epoch = ?"
            many = rows.execute(count, map_id).fetchone()[0] >= MOST_REFUSED_KEPT
            insert(rows, "refused", (*map_id, entry.sequence, reason, b"" if many else entry.message))
        else:
            changes.append(entry.change)
            self._insert(rows, entry, entry.change)

    def _insert(self, rows: Any, entry: Entry, change: Change) -> None:
        _, stamp_ns, body = unwrap_body(entry.message)
        kind, number = type(change.body).__name__, element_of(change.body).number
        values = (*change.map, entry.sequence, stamp_ns, kind, number, len(entry.message), body)
        insert(rows, "change", values)
        later = (
            "SELECT 1 FROM change WHERE agent = ? AND epoch = ? AND sequence > ? AND number = ? AND kind = ?"
        )
        if (
            isinstance(change.body, NodePut)
            and not rows.execute(later, (*change.map, entry.sequence, number, kind)).fetchone()
        ):
            insert(rows, "node", (*change.map, number, len(change.body.node.landmarks)))

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

    def _objection(self, change: Change) -> str:
        """Why a decoded change is refused; empty if it is accepted."""
        if isinstance(change.body, EdgePut) and len(change.body.edge.shared):
            edge = change.body.edge
            for end, highest in zip((edge.a, edge.b), edge.shared.max(axis=0), strict=True):
                count = self.landmarks(end)
                if count is not None and highest >= count:
                    return f"edge {edge.id} shares landmark {highest} of {end}, which has {count}"
        return ""

    def _read(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        with self._lock, self._database.guard():
            return self._database.connection.execute(query, values).fetchall()


def _words(gap: Gap) -> str:
    changes = f"change {gap.first}" if gap.first == gap.last else f"changes {gap.first} to {gap.last}"
    return f"{changes} of {gap.map}: damaged, and left out until {gap.map.agent} sends them again"
