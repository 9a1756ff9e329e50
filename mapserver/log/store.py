"""What a server keeps for good: every agent's log, exactly once and in order, and the server's own results.

There are two: one SQLite file (mapweave.mapserver.log.sqlite_store), and a PostgreSQL database that several
servers share (mapweave.mapserver.log.postgres_store).
"""

import logging
import secrets
import zlib
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass

from mapweave.hybridmap.annotation import MAX_ANNOTATIONS
from mapweave.hybridmap.change import Change, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue, MapweaveError
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.limits import MAX_NUMBER
from mapweave.mapserver.log.entry import Applied, Position, ReceivedChange
from mapweave.mapserver.log.sql_repairs import SqlRepairs, marks_of, numbers_of
from mapweave.storage.full_disks import logged
from mapweave.wire.codec import decode_body, element_of, unwrap_body
from mapweave.wire.log_messages import Refusal, StoredChange

log = logging.getLogger(__name__)

ID = "store id"
"""Among the results."""
HISTORY = "history"
"""Among the results, too: see mapweave.mapserver.map_history."""
PRUNING = "pruning"
"""Likewise: see mapweave.mapserver.merging.pruning."""
PRUNING_MARK = "pruning_mark"
"""A random number that is drawn with each change of that record."""
MERGE, MERGE_MARK = "merge", "merge_mark"
"""The newest merge, for servers that do not merge themselves, and a digest of it; see
mapweave.mapserver.merging.stored_merges."""
CHOICE_KEY = "choice key"
"""Likewise: decides which of many things are looked at, so that robots cannot. It never leaves the store."""
MERGE_TROUBLE = "merge_trouble"
"""Why the server that leads cannot merge, or hand its merges over, in words (UTF-8); empty if it can."""
SECRET_BYTES = 16
MOST_REFUSED_KEPT = 100
"""Refused changes of a map of which the bytes are kept; of further ones only the reason."""
MOST_REFUSALS = 1000
"""Reasons of a map that are kept; then a new one takes the place of the oldest that is kept without bytes."""
MAX_CONSTRAINTS = 10_000
"""Made by hand, one by one."""
READ_AT_ONCE = 256
"""Rows in memory at a time while a log is read: mostly of 3 kB each, so below 1 MB."""
OLDEST_REASON = (
    "DELETE FROM refused WHERE agent = ? AND epoch = ? AND sequence = (SELECT sequence FROM refused "
    "WHERE agent = ? AND epoch = ? ORDER BY sequence LIMIT 1 OFFSET ?)"
)
"""The first refusal of a map behind those of which the bytes are kept."""


@dataclass(frozen=True, slots=True)
class LogChanges:
    """The next changes of one log.

    Attributes:
        map_id: whose log.
        log_id: which.
        entries: in order of their sequence numbers.
        covered: the agent has nothing else up to here. Without it, entries behind a gap are left out.
    """

    map_id: MapId
    log_id: int
    entries: Sequence[ReceivedChange]
    covered: int | None = None


@dataclass(frozen=True, slots=True)
class News:
    """What other servers have written to a store that they share.

    Attributes:
        maps: whose logs have grown; None: any may have.
        records: names of results, `manual_constraint` or `annotation`; None: any may have changed.
    """

    maps: frozenset[MapId] | None
    records: frozenset[str] | None

    def names(self, record: str) -> bool:
        """Whether this record may have changed."""
        return self.records is None or record in self.records


EVERYTHING = News(None, None)
LEADS = News(frozenset(), frozenset({MERGE_MARK}))
"""Whether this server leads, or is followed, may have changed."""
CONSTRAINTS, ANNOTATIONS = "manual_constraint", "annotation"
"""Records, by the names of their tables."""


class Store(SqlRepairs):
    """The record of all logs. Any thread may call it; what it returns as done survives a loss of power.

    Its queries are those that SQLite and PostgreSQL both understand.

    Attributes:
        id: random, drawn when the store was made, see mapweave.wire.log_messages.Ack.
        shared: whether other servers may write to it, too.
    """

    id: int
    shared: bool

    @property
    @abstractmethod
    def leads(self) -> bool:
        """Whether this server writes the results of merging: one of those that share a store does."""

    @property
    def leader(self) -> str:
        """The server that leads; empty if that is not known."""
        return ""

    @property
    def term(self) -> int:
        """How often this server has begun to lead: what it wrote before then others may have written over."""
        return 0

    @property
    def followed(self) -> bool:
        """Whether this server leads others."""
        return False

    def publish(self, results: Mapping[str, bytes]) -> None:
        """Have results stored soon, if this server then leads, all at once. Returns at once.

        No commit of changes waits for it. What was not stored yet of earlier calls is stored with it.
        """

    @property
    @abstractmethod
    def displaced(self) -> str:
        """Why this server must end, in one line; empty if it need not.

        Another server of its name has taken a store that servers share. Nothing more is written.
        """

    @abstractmethod
    def follow(self, changed: Callable[[News], None]) -> None:
        """Have what other servers write reported from now on, from a thread of the store's.

        Before this server leads, it is called once more: what the leader before wrote is known then.
        """

    @abstractmethod
    def close(self) -> None:
        """Close it. Idempotent."""

    def maps(self, agent: str | None = None) -> list[MapId]:
        """All maps of a robot, or of all robots, of which something is known."""
        where, values = ("", ()) if agent is None else ("WHERE agent = ? ", (agent,))
        rows = self._read(f"SELECT agent, epoch FROM log {where}ORDER BY agent, epoch", values)
        return [MapId(*row) for row in rows]

    def positions(self, maps: Collection[MapId] | None = None) -> dict[MapId, Position]:
        """Which log is kept of each of these maps, or of all, and how far it is settled."""
        query = "SELECT agent, epoch, log_id, watermark FROM log"
        if maps is None:
            rows = self._read(query)
        else:
            rows = [row for m in maps for row in self._read(f"{query} WHERE agent = ? AND epoch = ?", m)]
        return {MapId(agent, epoch): Position(int(log_id), mark) for agent, epoch, log_id, mark in rows}

    def watermark(self, map_id: MapId) -> int:
        """Up to which change the log is settled, 0 without a log."""
        rows = self._read("SELECT watermark FROM log WHERE agent = ? AND epoch = ?", map_id)
        return int(rows[0][0]) if rows else 0

    def newest_change(self, map_id: MapId, watermark: int) -> StoredChange | None:
        """The newest change up to the watermark that is stored; None if there is none."""
        query = (
            "SELECT sequence, body FROM change WHERE agent = ? AND epoch = ? AND sequence <= ? "
            "ORDER BY sequence DESC LIMIT 1"
        )
        rows = self._read(query, (*map_id, watermark))
        return StoredChange(rows[0][0], zlib.crc32(rows[0][1])) if rows else None

    def apply(
        self, map_id: MapId, log_id: int, entries: Sequence[ReceivedChange], covered: int | None = None
    ) -> Applied:
        """Take the next changes of one log; see `apply_all`, and `LogChanges` for the arguments.

        Returns:
            What is new.

        Raises:
            InvalidValue: another log goes by this name.
            InvalidFile: the disk does not take it; nothing is applied.
        """
        (result,) = self.apply_all([LogChanges(map_id, log_id, entries, covered)])
        if isinstance(result, MapweaveError):
            raise result
        return result

    def apply_all(self, runs: Sequence[LogChanges]) -> list[Applied | MapweaveError]:
        """Take the next changes of many logs, all in one transaction with their watermarks.

        Duplicates are left out. A refused change is kept aside with its reason and the log goes on
        behind it: one bad change must not hold up a map for ever.

        Returns:
            For each run what is new, or its error: InvalidValue where another log goes by this name, which
            holds up no other run; InvalidFile for all if the disk does not take it, and nothing is applied.
        """
        try:
            with self._transaction():
                logs = self._begin(runs)
                return [self._apply(run, logs) for run in runs]
        except InvalidFile as error:
            return [copy(error) for _ in runs]

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

    def prune(
        self,
        nodes: Iterable[NodeId],
        edges: Iterable[EdgeId],
        results: Mapping[str, bytes],
        last: Mapping[MapId, int] | None = None,
        unchanged: Mapping[str, bytes | None] | None = None,
    ) -> bool:
        """Delete what logs say of some nodes and edges, for good, and store results in their place.

        All in one transaction. The logs' watermarks stay, so robots do not send them again.

        Args:
            nodes: that have left the map.
            edges: likewise.
            results: by their names, see `put_result`.
            last: up to which change of each log this is decided; what comes behind stays. None: all.
            unchanged: results that must still be these, since this is decided by them; None: not stored.

        Returns:
            Whether it is done: not if another server has written one of those results, and then nothing is.

        Raises:
            InvalidFile: the disk does not take it; nothing is pruned.
        """
        node_numbers, edge_numbers = numbers_of(nodes), numbers_of(edges)
        maps = {map_id for map_id, _ in (*node_numbers, *edge_numbers)}
        with self._transaction():
            self._lock_table("result")
            if any(self.result(name) != value for name, value in (unchanged or {}).items()):
                return False
            # No other server may put one of the nodes between the queries.
            self._begin([LogChanges(map_id, at.log_id, ()) for map_id, at in self.positions(maps).items()])
            for kinds, numbers in (
                ((NodePut, NodeRetired), node_numbers),
                ((EdgePut, EdgeRetired), edge_numbers),
            ):
                names = [kind.__name__ for kind in kinds]
                for map_id, some in numbers:
                    self._write(
                        "DELETE FROM change WHERE agent = ? AND epoch = ? AND sequence <= ? "
                        f"AND kind IN (?, ?) AND number IN ({marks_of(some)})",
                        (*map_id, MAX_NUMBER if last is None else last.get(map_id, 0), *names, *some),
                    )
            for map_id, some in node_numbers:
                put_again = self._read(
                    "SELECT DISTINCT number FROM change WHERE agent = ? AND epoch = ? AND kind = ? "
                    f"AND number IN ({marks_of(some)})",
                    (*map_id, NodePut.__name__, *some),
                )
                if gone := sorted({*some} - {number for (number,) in put_again}):
                    self._delete_nodes(map_id, gone)
            for name, value in results.items():
                self._put("result", (name, value))
        self._count_again()
        return True

    def refusals(self, map_id: MapId, newest: int = 16) -> list[Refusal]:
        """The newest changes of a map that were refused, in order."""
        query = (
            "SELECT sequence, reason FROM refused WHERE agent = ? AND epoch = ? "
            "ORDER BY sequence DESC LIMIT ?"
        )
        return [Refusal(*row) for row in reversed(self._read(query, (*map_id, newest)))]

    def refused(self) -> int:
        """How many changes of any map were refused; of each map at most `MOST_REFUSALS` count."""
        return int(self._read("SELECT count(*) FROM refused")[0][0])

    def constraints(self) -> list[bytes]:
        """The manual constraints, in order."""
        return self._record(CONSTRAINTS)

    def add_constraint(self, body: bytes) -> None:
        """Add a manual constraint.

        Raises:
            InvalidValue: there are too many.
            InvalidFile: the disk does not take it.
        """
        self._add_to_record(CONSTRAINTS, body, MAX_CONSTRAINTS)

    def annotations(self) -> list[bytes]:
        """The annotations, in order."""
        return self._record(ANNOTATIONS)

    def add_annotation(self, body: bytes) -> None:
        """Add an annotation; see `add_constraint`."""
        self._add_to_record(ANNOTATIONS, body, MAX_ANNOTATIONS)

    def put_result(self, name: str, value: bytes) -> None:
        """Store another result of the server.

        Raises:
            InvalidFile: the disk does not take it.
        """
        with self._transaction():
            self._put("result", (name, value))

    def replace_result(self, name: str, value: bytes, known: Collection[bytes | None]) -> bool:
        """Store another result, unless another server has written it meanwhile.

        Args:
            name: of the result.
            value: to be stored.
            known: what may be stored now; None: nothing.

        Returns:
            Whether it is stored: not if what is there is none of these.

        Raises:
            InvalidFile: the disk does not take it.
        """
        with self._transaction():
            self._lock_table("result")
            if self.result(name) not in known:
                return False
            self._put("result", (name, value))
        return True

    def result(self, name: str) -> bytes | None:
        """The result of this name."""
        rows = self._read("SELECT value FROM result WHERE name = ?", (name,))
        return bytes(rows[0][0]) if rows else None

    def secret(self, name: str) -> bytes:
        """Random bytes of this name: drawn when they are asked for first, and the same ever after.

        Where several servers share the store they are the same for all. A disk that does not take them, which
        is logged, is no error: they are others then after the next start.
        """
        known = self.result(name)
        if known is None:
            known = secrets.token_bytes(SECRET_BYTES)
            try:
                with self._transaction():
                    self._lock_table("result")
                    known = self.result(name) or known
                    self._put("result", (name, known))
            except InvalidFile as error:
                if not logged(error):
                    log.warning("%s", error)
        return known

    def _apply(self, run: LogChanges, logs: dict[MapId, Position]) -> Applied | MapweaveError:
        stored_id, watermark = logs.get(run.map_id, (run.log_id, 0))
        if stored_id != run.log_id and watermark > 0:
            return InvalidValue(f"another log goes by the name {run.map_id}: begin a fresh map")
        before = watermark
        changes: list[Change] = []
        refusals: list[Refusal] = []
        for entry in run.entries:
            if entry.sequence <= watermark:
                continue
            if entry.sequence > watermark + 1 and run.covered is None:
                break
            self._take(run.map_id, entry, changes, refusals)
            watermark = entry.sequence
        watermark = max(watermark, run.covered or 0)
        self._put("log", (*run.map_id, str(run.log_id), watermark))
        logs[run.map_id] = Position(run.log_id, watermark)
        return Applied(tuple(changes), tuple(refusals), watermark, before)

    def _record(self, table: str) -> list[bytes]:
        return [bytes(body) for (body,) in self._read(f"SELECT body FROM {table} ORDER BY number")]

    def _add_to_record(self, table: str, body: bytes, most: int) -> None:
        with self._transaction():
            self._lock_table(table)
            count, newest = self._read(f"SELECT count(*), coalesce(max(number), 0) FROM {table}")[0]
            if count >= most:
                raise InvalidValue(f"the record of {table.replace('_', ' ')}s is full: {most}")
            self._put(table, (newest + 1, body))

    def _take(
        self,
        map_id: MapId,
        entry: ReceivedChange,
        changes: list[Change],
        refusals: list[Refusal],
        restored: bool = False,
    ) -> None:
        """Store a change, or store it aside with the reason."""
        reason = entry.change if isinstance(entry.change, str) else self._objection(entry.change)
        if isinstance(entry.change, str) or reason:
            refusals.append(Refusal(entry.sequence, reason))
            count = self._read("SELECT count(*) FROM refused WHERE agent = ? AND epoch = ?", map_id)[0][0]
            if count >= MOST_REFUSALS:
                self._write(OLDEST_REASON, (*map_id, *map_id, MOST_REFUSED_KEPT))
            message = b"" if count >= MOST_REFUSED_KEPT else entry.message
            self._put("refused", (*map_id, entry.sequence, reason, message))
        else:
            changes.append(entry.change)
            self._insert(entry, entry.change, restored)

    def _insert(self, entry: ReceivedChange, change: Change, restored: bool) -> None:
        _, stamp_ns, body = unwrap_body(entry.message)
        kind, number = type(change.body).__name__, element_of(change.body).number
        values = (*change.map, entry.sequence, stamp_ns, kind, number, len(entry.message), body)
        self._put("change", values)
        later = (
            "SELECT 1 FROM change WHERE agent = ? AND epoch = ? AND sequence > ? AND number = ? AND kind = ?"
        )
        if isinstance(change.body, NodePut) and not (
            restored and self._read(later, (*change.map, entry.sequence, number, kind))
        ):
            self._put("node", (*change.map, number, len(change.body.node.landmarks)))

    def _objection(self, change: Change) -> str:
        """Why a decoded change is refused; empty if it is accepted."""
        if isinstance(change.body, EdgePut) and len(change.body.edge.shared):
            edge = change.body.edge
            for end, highest in zip((edge.a, edge.b), edge.shared.max(axis=0), strict=True):
                count = self.landmarks(end)
                if count is not None and highest >= count:
                    return f"edge {edge.id} shares landmark {highest} of {end}, which has {count}"
        return ""

    @abstractmethod
    def _begin(self, runs: Sequence[LogChanges]) -> dict[MapId, Position]:
        """The logs of these runs that are stored; only this transaction changes them until the commit."""

    @abstractmethod
    def _lock_table(self, table: str) -> None:
        """Only this transaction changes it until the commit."""


def fresh_id() -> int:
    """An id for a store that is made now."""
    return secrets.randbits(62) + 1
