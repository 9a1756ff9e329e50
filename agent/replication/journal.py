"""The agent's own disk: every change of its maps, written before it is sent."""

from __future__ import annotations

import logging
import secrets
import threading
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from mapweave.agent.replication.compaction import undone
from mapweave.agent.replication.log_entry import LogEntry
from mapweave.hybridmap.change import Change, ChangeBody, EdgeRetired, NodeRetired
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId, check_name
from mapweave.hybridmap.mission_order import MAX_KEPT, MissionReport, Missions
from mapweave.storage.database import Database
from mapweave.wire.codec import decode_body, element_of, encode_body, puts_node, wrap_body
from mapweave.wire.keys import check_epoch
from mapweave.wire.log_messages import StoredChange
from mapweave.wire.messages import decode, encode

log = logging.getLogger(__name__)

APPLICATION_ID = 0x4D574A4C
"""'MWJL' in the file's header."""

VERSION = 1
SCHEMA = """
CREATE TABLE owner (agent TEXT NOT NULL);
CREATE TABLE map (epoch INTEGER PRIMARY KEY, log_id INTEGER NOT NULL);
CREATE TABLE change (
    epoch INTEGER NOT NULL, sequence INTEGER NOT NULL, element INTEGER NOT NULL, put INTEGER NOT NULL,
    stamp_ns INTEGER NOT NULL, body BLOB NOT NULL, crc INTEGER NOT NULL, PRIMARY KEY (epoch, sequence)
) WITHOUT ROWID;
CREATE TABLE ack (
    epoch INTEGER NOT NULL, server TEXT NOT NULL, watermark INTEGER NOT NULL, PRIMARY KEY (epoch, server)
) WITHOUT ROWID;
CREATE TABLE mission (id TEXT PRIMARY KEY, body BLOB NOT NULL, crc INTEGER NOT NULL);
CREATE TABLE checksum (name TEXT PRIMARY KEY, crc INTEGER NOT NULL)
"""

READ_AT_ONCE = 256
"""Changes in memory at a time while a map is read: mostly of 3 kB each, so below 1 MB."""
ADVICE = (
    "save what can be read with `mapweave map extract FILE -o FOLDER`, then move the file away: the agent "
    "begins a new map"
)


@dataclass(frozen=True, slots=True)
class Draft:
    """A change that is encoded but has no number yet.

    Attributes:
        map: whose log it belongs to.
        element: number of the node or edge that it is about.
        put: whether it puts, or retires.
        stamp_ns: when the agent made it.
        encoded: the body.
    """

    map: MapId
    element: int
    put: bool
    stamp_ns: int
    encoded: bytes

    @staticmethod
    def of(body: ChangeBody, stamp_ns: int) -> Draft:
        """Encode a body; raises InvalidValue if it cannot be encoded."""
        element = element_of(body)
        put = not isinstance(body, NodeRetired | EdgeRetired)
        encoded = encode_body(body)
        wrap_body(1, stamp_ns, encoded)
        return Draft(element.map, element.number, put, stamp_ns, encoded)


def checksum(key: Sequence[object], encoded: bytes) -> int:
    """Checksum of a row of `change`: its body in the lower 32 bits, what precedes it in the 31 above."""
    return _of_key(key) << 32 | zlib.crc32(encoded)


def key_holds(key: Sequence[object], crc: object) -> bool:
    """Whether what precedes the body of a row, its number and stamp for example, is what was written."""
    return isinstance(crc, int) and crc >> 32 == _of_key(key)


def body_of(encoded: object, crc: int) -> ChangeBody | None:
    """The body of a row; None if the disk has damaged it."""
    try:
        return decode_body(encoded) if _body_holds(encoded, crc) else None
    except InvalidMessage:
        return None


def entry_of(map_id: MapId, sequence: int, number: int, put: int, encoded: object, crc: int) -> LogEntry:
    """A row of a map's log as an entry; its element is that of its body if that is undamaged."""
    body = body_of(encoded, crc)
    if body is None or element_of(body).map != map_id:
        return LogEntry(sequence, NodeId(*map_id, number), bool(put), None)
    return LogEntry(sequence, element_of(body), not isinstance(body, NodeRetired | EdgeRetired), body)


def _of_key(key: Sequence[object]) -> int:
    return zlib.crc32(repr(tuple(key)).encode()) >> 1


def _body_holds(encoded: object, crc: int) -> TypeGuard[bytes]:
    return isinstance(encoded, bytes) and zlib.crc32(encoded) == crc & 0xFFFFFFFF


class Journal:
    """The change logs of one agent in one SQLite file. Its methods may be called from any thread.

    What is committed here outlasts a loss of power. The journal is also the robot's map after a restart, so
    nothing that the map still needs is ever dropped.
    """

    def __init__(self, path: Path, agent: str | None = None) -> None:
        """Open the journal, or begin one.

        Args:
            path: of the file.
            agent: whose; None takes whose it is and only reads: neither file nor folder is changed.

        Raises:
            InvalidFile: damaged, of another kind, another agent's, without an owner, or in use.
        """
        if agent is not None:
            check_name(agent)
        self._lock = threading.RLock()
        self._newest: dict[MapId, int] = {}
        self._database = Database(
            path, "agent journal", APPLICATION_ID, VERSION, SCHEMA, None, ADVICE,
            read_only=agent is None, refuse_loss=True,
        )  # fmt: skip
        try:
            self.agent = self._owner(path) if agent is None else self._own(path, agent)
            self._check_keys()
        except BaseException:
            self._database.close()
            raise

    def _owner(self, path: Path) -> str:
        rows = self._read("SELECT agent FROM owner")
        if not rows:
            raise InvalidFile(f"{path}: this journal has no owner")
        return str(rows[0][0])

    def _own(self, path: Path, agent: str) -> str:
        with self._database.transaction() as rows:
            owner = rows.execute("SELECT agent FROM owner").fetchone()
            if owner is None:
                rows.execute("INSERT INTO owner VALUES (?)", (agent,))
            elif owner[0] != agent:
                raise InvalidFile(f"{path}: is the journal of agent {owner[0]}, not of {agent}")
            if not self._table_holds("map"):
                raise self._database.damaged("its list of maps")
            if not self._table_holds("ack"):
                log.warning("%s: what servers have acknowledged is damaged; they are asked again", path)
                rows.execute("DELETE FROM ack")
                self._sum_table("ack")
        return agent

    def _check_keys(self) -> None:
        """Refuse a journal with a number or a stamp that is not what was written: its order is not known."""
        with self._database.guard():
            for *key, crc in self._database.connection.execute(
                "SELECT epoch, sequence, element, put, stamp_ns, crc FROM change"
            ):
                if not key_holds(key, crc):
                    raise self._database.damaged(
                        f"the number or the stamp of a change, {key[1]} as it stands"
                    )

    def _table_holds(self, table: str) -> bool:
        rows = self._read("SELECT crc FROM checksum WHERE name = ?", (table,))
        return not rows or rows[0][0] == self._of_table(table)

    def _sum_table(self, table: str) -> None:
        """Write the checksum of a small table, in the transaction that changes it."""
        values = (table, self._of_table(table))
        self._database.connection.execute("INSERT OR REPLACE INTO checksum VALUES (?, ?)", values)

    def _of_table(self, table: str) -> int:
        return zlib.crc32(repr(self._read(f"SELECT * FROM {table} ORDER BY 1, 2")).encode())

    def open_map(self, epoch: int | None) -> MapId:
        """Begin a map or go on with one.

        Args:
            epoch: of the map; one that is there is resumed. None begins a fresh one with the next number.

        Raises:
            InvalidValue: the epoch is out of range.
            InvalidFile: the disk does not take it.
        """
        if epoch is not None:
            check_epoch(epoch)
        with self._lock, self._database.transaction() as rows:
            if epoch is None:
                epoch = int(rows.execute("SELECT coalesce(max(epoch), 0) + 1 FROM map").fetchone()[0])
            # A number that an agent with a lost disk will not draw again; SQLite's integers have a sign.
            rows.execute("INSERT OR IGNORE INTO map VALUES (?, ?)", (epoch, secrets.randbits(63)))
            self._sum_table("map")
        return MapId(self.agent, epoch)

    def maps(self) -> list[MapId]:
        """All maps, oldest first."""
        return [MapId(self.agent, epoch) for (epoch,) in self._read("SELECT epoch FROM map ORDER BY epoch")]

    def log_id(self, map_id: MapId) -> int:
        """What distinguishes this log from any other with the same name, see mapweave.wire.log_messages.Mark.

        Raises:
            InvalidValue: no such map was opened.
        """
        rows = self._read("SELECT log_id FROM map WHERE epoch = ?", self._epoch(map_id))
        if not rows:
            raise InvalidValue(f"map {map_id} was never opened in this journal")
        return int(rows[0][0])

    def head(self, map_id: MapId) -> int:
        """Sequence number of the newest change, 0 if there is none."""
        query = "SELECT coalesce(max(sequence), 0) FROM change WHERE epoch = ?"
        return int(self._read(query, self._epoch(map_id))[0][0])

    def contradicts(self, map_id: MapId, stored: StoredChange) -> bool:
        """Whether a log has another change by a number than a server has.

        One that was dropped since, or that the disk has damaged, contradicts nothing.
        """
        query = "SELECT body, crc FROM change WHERE epoch = ? AND sequence = ?"
        rows = self._read(query, (*self._epoch(map_id), stored.sequence))
        return any(_body_holds(body, crc) and crc & 0xFFFFFFFF != stored.crc for body, crc in rows)

    def append(self, map_id: MapId, bodies: Iterable[ChangeBody], stamp_ns: int) -> list[Change]:
        """Write changes in one transaction; they are on the disk when this returns.

        Raises:
            InvalidValue: a body cannot be encoded or belongs to another map; nothing was written.
            InvalidFile: the disk does not take it; nothing was written.
        """
        bodies = list(bodies)
        first = self.write(map_id, [Draft.of(body, stamp_ns) for body in bodies])
        return [Change(map_id, first + k, stamp_ns, body) for k, body in enumerate(bodies)]

    def write(self, map_id: MapId, drafts: Sequence[Draft]) -> int:
        """Write encoded changes in one transaction.

        Returns:
            The first one's sequence number; the others follow without gaps.

        Raises:
            InvalidValue: one belongs to another map, or the map was never opened; nothing was written.
            InvalidFile: the disk does not take it; nothing was written.
        """
        for draft in drafts:
            if draft.map != map_id:
                raise InvalidValue(f"a change of {draft.map} does not belong into the log of {map_id}")
        with self._lock:
            first = self._newest_of(map_id) + 1
            with self._database.transaction() as rows:
                keys = [
                    (map_id.epoch, first + k, d.element, int(d.put), d.stamp_ns) for k, d in enumerate(drafts)
                ]
                rows.executemany(
                    "INSERT INTO change VALUES (?, ?, ?, ?, ?, ?, ?)",
                    (
                        (*key, d.encoded, checksum(key, d.encoded))
                        for key, d in zip(keys, drafts, strict=True)
                    ),
                )
            self._newest[map_id] = first + len(drafts) - 1
        return first

    def _newest_of(self, map_id: MapId) -> int:
        """`head`, read once: no one else writes the file.

        Raises:
            InvalidValue: the map was never opened.
        """
        if map_id not in self._newest:
            self.log_id(map_id)
            self._newest[map_id] = self.head(map_id)
        return self._newest[map_id]

    def rows(self, map_id: MapId, first: int, last: int) -> list[tuple[int, bytes]]:
        """Changes first to last, both included, as (sequence, encoded change).

        An empty one represents a change that the disk has damaged: servers refuse it and go on after it.
        """
        return [
            (sequence, b"" if body is None else wrap_body(sequence, stamp_ns, body))
            for sequence, stamp_ns, body in self._bodies(map_id, first, last)
        ]

    def changes(self, map_id: MapId, first: int, last: int) -> list[Change]:
        """Changes first to last, both included.

        Raises:
            InvalidFile: a change is damaged.
        """
        return [
            Change(map_id, sequence, stamp_ns, self._decode(sequence, body))
            for sequence, stamp_ns, body in self._bodies(map_id, first, last)
        ]

    def replay(self, map_id: MapId) -> Iterator[ChangeBody]:
        """The map's content, change by change.

        Raises:
            InvalidFile: a change is damaged.
        """
        head = self.head(map_id)
        for begin in range(1, head + 1, READ_AT_ONCE):
            for change in self.changes(map_id, begin, min(begin + READ_AT_ONCE - 1, head)):
                yield change.body

    def entries(self, map_id: MapId) -> Iterator[LogEntry]:
        """Every change that is still there, in order; damaged ones without a body."""
        query = "SELECT sequence, element, put, body, crc FROM change WHERE epoch = ? ORDER BY sequence"
        for row in self._read(query, self._epoch(map_id)):
            yield entry_of(map_id, *row)

    def nodes(self, map_id: MapId) -> list[NodeId]:
        """Nodes of a map that are not retired, without reading their contents.

        Raises:
            InvalidFile: a change is damaged, which may have been a node.
        """
        query = "SELECT sequence, element, put, body, crc FROM change WHERE epoch = ? ORDER BY sequence"
        there: dict[int, bool] = {}
        for sequence, element, put, body, crc in self._read(query, self._epoch(map_id)):
            if not put:
                there.pop(element, None)
                continue
            try:
                if not _body_holds(body, crc):
                    raise InvalidMessage("is not what was written")
                there[element] = puts_node(body)
            except InvalidMessage as error:
                raise self._damaged(sequence, error) from None
        return [NodeId(*map_id, element) for element, is_node in sorted(there.items()) if is_node]

    def newest_stamp(self, map_id: MapId) -> int:
        """The latest stamp of a map's changes, ns; 0 if there are none."""
        query = "SELECT coalesce(max(stamp_ns), 0) FROM change WHERE epoch = ?"
        return int(self._read(query, self._epoch(map_id))[0][0])

    def acknowledge(self, server: str, map_id: MapId, watermark: int, reset: bool = False) -> None:
        """Remember that a server has every change up to the watermark; it never goes back.

        Args:
            server: which.
            map_id: which map.
            watermark: up to which change.
            reset: the server has lost its store, so it may go back.

        Raises:
            InvalidValue: the log is not that long, or the map was never opened.
            InvalidFile: the disk does not take it.
        """
        with self._lock:
            head = self._newest_of(map_id)
            if not 0 <= watermark <= head:
                raise InvalidValue(f"{server} acknowledges {watermark} changes of {map_id}, there are {head}")
            with self._database.transaction() as rows:
                rows.execute(
                    "INSERT INTO ack VALUES (?, ?, ?) ON CONFLICT (epoch, server) "
                    "DO UPDATE SET watermark = max(watermark * ?, excluded.watermark)",
                    (map_id.epoch, check_name(server), watermark, not reset),
                )
                self._sum_table("ack")

    def acknowledged(self, map_id: MapId) -> dict[str, int]:
        """Up to which change which server has the log."""
        query = "SELECT server, watermark FROM ack WHERE epoch = ? ORDER BY server"
        return dict(self._read(query, self._epoch(map_id)))

    def note_put_back(self, map_id: MapId) -> None:
        """Remember that servers have other changes of a log by the numbers of those that are here.

        Raises:
            InvalidFile: the disk does not take it.
        """
        with self._lock, self._database.transaction() as rows:
            # No journal but those few has this table, so that all others stay as older versions know them.
            rows.execute("CREATE TABLE IF NOT EXISTS put_back (epoch INTEGER PRIMARY KEY)")
            rows.execute("INSERT OR IGNORE INTO put_back VALUES (?)", self._epoch(map_id))

    def was_put_back(self, map_id: MapId) -> bool:
        """Whether that was noted of a log."""
        if not self._read("SELECT 1 FROM sqlite_master WHERE name = 'put_back'"):
            return False
        return bool(self._read("SELECT 1 FROM put_back WHERE epoch = ?", self._epoch(map_id)))

    def prune(self, map_id: MapId, servers: Iterable[str]) -> int:
        """Drop changes that every one of the servers has and that a later change of the same log undoes.

        The replay gives the same map before and after (its nodes perhaps in another order). Retirements of
        which nothing is left to undo go as well, once each server that has ever had anything of the log has
        them; not the newest change, nor that of the greatest number: they say which come next.

        Returns:
            How many were dropped.

        Raises:
            InvalidFile: the disk does not take it.
        """
        with self._lock:
            acknowledged = self.acknowledged(map_id)
            limit = min((acknowledged.get(server, 0) for server in servers), default=0)
            with self._database.transaction() as rows:
                dropped = rows.execute(
                    "DELETE FROM change WHERE epoch = :epoch AND sequence <= :limit AND put AND sequence "
                    "NOT IN (SELECT max(sequence) FROM change WHERE epoch = :epoch AND sequence <= :limit "
                    "GROUP BY element)",
                    {"epoch": map_id.epoch, "limit": limit},
                ).rowcount
                retired = "SELECT 1 FROM change WHERE epoch = ? AND NOT put AND sequence <= ? LIMIT 1"
                if rows.execute(retired, (map_id.epoch, limit)).fetchone() is None:
                    return dropped
                some = undone(self.entries(map_id), limit, min([limit, *acknowledged.values()]))
                rows.executemany(
                    "DELETE FROM change WHERE epoch = ? AND sequence = ?",
                    ((map_id.epoch, sequence) for sequence in some),
                )
                return dropped + len(some)

    def missions(self) -> list[MissionReport]:
        """Missions that were kept; one that is damaged is left out, and the log says so."""
        reports = []
        for body, crc in self._read("SELECT body, crc FROM mission"):
            try:
                if not _body_holds(body, crc):
                    raise InvalidMessage("is not what was written")
                reports.append(decode(body, MissionReport))
            except InvalidMessage:
                log.warning("%s: a mission is damaged; it is left out", self._database.path)
        return list(Missions.newest(reports).reports)

    def keep_missions(self, reports: Sequence[MissionReport]) -> None:
        """Write what has become of missions in one transaction; the oldest of many are dropped.

        Raises:
            InvalidFile: the disk does not take it.
        """
        encoded = [(report, encode(report)) for report in reports]
        with self._lock, self._database.transaction() as rows:
            rows.executemany(
                "INSERT OR REPLACE INTO mission VALUES (?, ?, ?)",
                ((report.order.id, body, zlib.crc32(body)) for report, body in encoded),
            )
            rows.execute(
                "DELETE FROM mission WHERE rowid NOT IN "
                "(SELECT rowid FROM mission ORDER BY rowid DESC LIMIT ?)",
                (MAX_KEPT,),
            )

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._database.close()

    def _epoch(self, map_id: MapId) -> tuple[int]:
        if map_id.agent != self.agent:
            raise InvalidValue(f"the journal of {self.agent} has no map {map_id}")
        return (map_id.epoch,)

    def _read(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        with self._lock, self._database.guard():
            return self._database.connection.execute(query, values).fetchall()

    def _bodies(self, map_id: MapId, first: int, last: int) -> Iterator[tuple[int, int, bytes | None]]:
        """Sequence, stamp and encoded body of each change; None for a body that is not what was written."""
        query = (
            "SELECT sequence, stamp_ns, body, crc FROM change "
            "WHERE epoch = ? AND sequence BETWEEN ? AND ? ORDER BY sequence"
        )
        for sequence, stamp_ns, body, crc in self._read(query, (*self._epoch(map_id), first, last)):
            yield sequence, stamp_ns, body if _body_holds(body, crc) else None

    def _decode(self, sequence: int, body: bytes | None) -> ChangeBody:
        if body is None:
            raise InvalidFile(f"{self._database.path}: change {sequence} is damaged")
        try:
            return decode_body(body)
        except InvalidMessage as error:
            raise self._damaged(sequence, error) from None

    def _damaged(self, sequence: int, error: InvalidMessage) -> InvalidFile:
        return InvalidFile(f"{self._database.path}: change {sequence}: {error}")
