"""The server's disk: every agent's log, exactly once and in order, and what the server itself has decided."""

from __future__ import annotations

import logging
import secrets
import threading
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hybridmap.change import Change, EdgePut, NodePut, NodeRetired
from hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from hybridmap.node import Edge, EdgeId, MapId, NodeId
from mapserver.log.entry import Applied, Entry, Position, Traffic
from wire.codec import decode_body, element_of, encode_body, unwrap_body
from wire.database import Database
from wire.log_messages import Refusal

log = logging.getLogger(__name__)

APPLICATION_ID = 0x4D575354
"""'MWST' in the file's header."""

VERSION = 1
SCHEMA = """
CREATE TABLE log (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, log_id TEXT NOT NULL, watermark INTEGER NOT NULL,
    PRIMARY KEY (agent, epoch)
) WITHOUT ROWID;
CREATE TABLE change (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL, stamp_ns INTEGER NOT NULL,
    kind TEXT NOT NULL, number INTEGER NOT NULL, wire_bytes INTEGER NOT NULL, body BLOB NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (agent, epoch, sequence)
) WITHOUT ROWID;
CREATE TABLE node (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, number INTEGER NOT NULL, landmarks INTEGER NOT NULL,
    PRIMARY KEY (agent, epoch, number)
) WITHOUT ROWID;
CREATE TABLE refused (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL, reason TEXT NOT NULL,
    message BLOB NOT NULL, PRIMARY KEY (agent, epoch, sequence)
) WITHOUT ROWID;
CREATE TABLE link (
    agent TEXT NOT NULL, epoch INTEGER NOT NULL, number INTEGER NOT NULL, undone INTEGER NOT NULL,
    body BLOB NOT NULL, PRIMARY KEY (agent, epoch, number)
) WITHOUT ROWID;
CREATE TABLE result (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID
"""

ID = "store id"
"""Among the results."""
READ_AT_ONCE = 256


class Store:
    """All logs in one SQLite file. Its methods may be called from any thread.

    Attributes:
        id: drawn by chance when the store was made, see wire.log_messages.Ack.
    """

    def __init__(self, path: Path) -> None:
        """Open the store, or make one.

        Raises:
            InvalidFile: damaged, of another kind, or in use.
        """
        self._lock = threading.RLock()
        self._database = Database(path, "map store", APPLICATION_ID, VERSION, SCHEMA)
        known = self.result(ID)
        self.id = int.from_bytes(known, "big") if known else secrets.randbits(62) + 1
        if not known:
            try:
                self.put_result(ID, self.id.to_bytes(8, "big"))
            except InvalidFile as error:
                # Such a store takes nothing in either, and can still be read.
                log.warning("%s", error)

    def maps(self) -> list[MapId]:
        """All maps of which something is known."""
        return [MapId(*row) for row in self._read("SELECT agent, epoch FROM log ORDER BY agent, epoch")]

    def positions(self) -> dict[MapId, Position]:
        """Which log is kept of each map, and how far it is settled."""
        rows = self._read("SELECT agent, epoch, log_id, watermark FROM log")
        return {MapId(agent, epoch): Position(int(log_id), mark) for agent, epoch, log_id, mark in rows}

    def present(self) -> set[NodeId]:
        """All nodes that are not retired, without a look at what is in them."""
        query = (
            "SELECT agent, epoch, number, kind FROM change WHERE kind IN (?, ?) "
            "ORDER BY agent, epoch, sequence"
        )
        nodes: set[NodeId] = set()
        for *element, kind in self._read(query, (NodePut.__name__, NodeRetired.__name__)):
            (nodes.add if kind == NodePut.__name__ else nodes.discard)(NodeId(*element))
        return nodes

    def watermark(self, map_id: MapId) -> int:
        """Up to which change the log is settled, 0 if nothing is known."""
        found = self._read("SELECT watermark FROM log WHERE agent = ? AND epoch = ?", map_id)
        return int(found[0][0]) if found else 0

    def log_id(self, map_id: MapId) -> int | None:
        """Which log goes by this name, None if nothing is known."""
        found = self._read("SELECT log_id FROM log WHERE agent = ? AND epoch = ?", map_id)
        return int(found[0][0]) if found else None

    def apply(
        self, map_id: MapId, log_id: int, entries: Sequence[Entry], covered: int | None = None
    ) -> Applied:
        """Take the next changes of a log, in one transaction with its watermark.

        Doubles are left out. A change that cannot be taken is kept aside with its reason and the log goes on
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
            known = self.log_id(map_id)
            if known is not None and known != log_id:
                raise InvalidValue(f"another log goes by the name {map_id}: begin a fresh map")
            watermark = self.watermark(map_id)
            for entry in entries:
                if entry.sequence <= watermark:
                    continue
                if entry.sequence > watermark + 1 and covered is None:
                    break
                reason = entry.change if isinstance(entry.change, str) else self._objection(entry.change)
                if isinstance(entry.change, str) or reason:
                    refusals.append(Refusal(entry.sequence, reason))
                    values = (*map_id, entry.sequence, reason, entry.message)
                    rows.execute("INSERT INTO refused VALUES (?, ?, ?, ?, ?)", values)
                else:
                    changes.append(entry.change)
                    self._insert(rows, entry, entry.change)
                watermark = entry.sequence
            watermark = max(watermark, covered or 0)
            rows.execute(
                "INSERT INTO log VALUES (?, ?, ?, ?) ON CONFLICT (agent, epoch) "
                "DO UPDATE SET watermark = excluded.watermark",
                (*map_id, str(log_id), watermark),
            )
        return Applied(tuple(changes), tuple(refusals), watermark)

    def replay(self, map_id: MapId) -> Iterator[Change]:
        """Every change that was taken, in order; without those that are out of bounds since then.

        Raises:
            InvalidFile: a change is damaged.
        """
        query = (
            "SELECT sequence, stamp_ns, body, crc FROM change "
            "WHERE agent = ? AND epoch = ? AND sequence > ? ORDER BY sequence LIMIT ?"
        )
        last = 0
        while found := self._read(query, (*map_id, last, READ_AT_ONCE)):
            for last, stamp_ns, body, crc in found:
                if zlib.crc32(body) != crc:
                    raise InvalidFile(f"{self._database.path}: change {last} of {map_id} is damaged")
                try:
                    yield Change(map_id, last, stamp_ns, decode_body(body))
                except InvalidMessage as error:
                    # An older program took it. It stays on the disk; the map is made without it.
                    log.warning("change %d of %s in the store is left out: %s", last, map_id, error)

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

    def put_link(self, edge: Edge) -> None:
        """Keep an edge that the server itself has found; one that was undone is valid again.

        Raises:
            InvalidValue: it cannot be encoded.
            InvalidFile: the disk does not take it.
        """
        encoded = encode_body(EdgePut(edge))
        with self._lock, self._database.transaction() as rows:
            rows.execute("INSERT OR REPLACE INTO link VALUES (?, ?, ?, 0, ?)", (*edge.id, encoded))

    def undo_link(self, link: EdgeId) -> bool:
        """Mark a link as undone; it stays on the disk. False if there is no such link in force."""
        with self._lock, self._database.transaction() as rows:
            query = "UPDATE link SET undone = 1 WHERE agent = ? AND epoch = ? AND number = ? AND NOT undone"
            return rows.execute(query, link).rowcount > 0

    def links(self, *, undone: bool = False) -> list[Edge]:
        """The server's own links that are in force, or those that were undone."""
        query = "SELECT body FROM link WHERE undone = ? ORDER BY agent, epoch, number"
        bodies = [decode_body(body) for (body,) in self._read(query, (undone,))]
        return [body.edge for body in bodies if isinstance(body, EdgePut)]

    def put_result(self, name: str, value: bytes) -> None:
        """Keep something else that the server has worked out.

        Raises:
            InvalidFile: the disk does not take it.
        """
        with self._lock, self._database.transaction() as rows:
            rows.execute("INSERT OR REPLACE INTO result VALUES (?, ?)", (name, value))

    def result(self, name: str) -> bytes | None:
        """What was kept under this name."""
        found = self._read("SELECT value FROM result WHERE name = ?", (name,))
        return bytes(found[0][0]) if found else None

    def close(self) -> None:
        """Let go of the file. Twice is no error."""
        with self._lock:
            self._database.close()

    def _insert(self, rows: Any, entry: Entry, change: Change) -> None:
        _, stamp_ns, body = unwrap_body(entry.message)
        kind, number = type(change.body).__name__, element_of(change.body).number
        rows.execute(
            "INSERT INTO change VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (*change.map, entry.sequence, stamp_ns, kind, number, len(entry.message), body, zlib.crc32(body)),
        )
        if isinstance(change.body, NodePut):
            count = len(change.body.node.landmarks)
            rows.execute("INSERT OR REPLACE INTO node VALUES (?, ?, ?, ?)", (*change.map, number, count))

    def _objection(self, change: Change) -> str:
        """Why a change that decodes still cannot be taken; empty if it can."""
        if isinstance(change.body, EdgePut) and len(change.body.edge.shared):
            edge = change.body.edge
            for end, highest in zip((edge.a, edge.b), edge.shared.max(axis=0), strict=True):
                count = self._landmarks(end)
                if count is not None and highest >= count:
                    return f"edge {edge.id} shares landmark {highest} of {end}, which has {count}"
        return ""

    def _landmarks(self, node: NodeId) -> int | None:
        query = "SELECT landmarks FROM node WHERE agent = ? AND epoch = ? AND number = ?"
        found = self._read(query, node)
        return int(found[0][0]) if found else None

    def _read(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        with self._lock, self._database.guard():
            return self._database.connection.execute(query, values).fetchall()
