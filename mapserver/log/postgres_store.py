"""The store in a PostgreSQL database, which several servers may share.

Damage is PostgreSQL's to find: its pages have checksums where `initdb --data-checksums` made it, and a
standby has good ones. So rows have no checksums of their own here, and nothing is salvaged.
"""

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import psycopg

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.entry import Position
from mapweave.mapserver.log.postgres_follower import CHANNEL, LOG, RECORD, PostgresFollower, words_of
from mapweave.mapserver.log.postgres_name import ServerName
from mapweave.mapserver.log.store import ANNOTATIONS, CONSTRAINTS, ID, LogChanges, News, Store, fresh_id
from mapweave.storage.file_format import what_to_do
from mapweave.storage.full_disks import CALM, written
from mapweave.storage.postgres_session import PostgresAddress, PostgresSession
from mapweave.storage.postgres_watchdog import PostgresWatchdog

log = logging.getLogger(__name__)

VERSION = 1
KEYS = {
    "log": ("agent", "epoch"),
    "change": ("agent", "epoch", "sequence"),
    "damaged": ("agent", "epoch", "first"),
    "unverified": ("agent", "epoch"),
    "node": ("agent", "epoch", "number"),
    "refused": ("agent", "epoch", "sequence"),
    "manual_constraint": ("number",),
    "annotation": ("number",),
    "result": ("name",),
}
"""Of the tables."""
VALUES = {
    "log": ("log_id", "watermark"),
    "change": ("stamp_ns", "kind", "number", "wire_bytes", "body"),
    "damaged": ("last",),
    "unverified": ("first", "last"),
    "node": ("landmarks",),
    "refused": ("reason", "message"),
    "manual_constraint": ("body",),
    "annotation": ("body",),
    "result": ("value",),
}
"""Their other columns."""
TYPES = {
    **dict.fromkeys(("agent", "log_id", "kind", "reason", "name"), 'TEXT COLLATE "C" NOT NULL'),
    **dict.fromkeys(("body", "message", "value"), "BYTEA NOT NULL"),
}
"""Of columns that are no numbers."""
TABLES_THERE = (
    "SELECT relname, EXISTS (SELECT FROM pg_constraint WHERE conrelid = pg_class.oid AND contype = 'p') "
    "FROM pg_class WHERE relkind = 'r' AND relnamespace = to_regnamespace('mapweave')"
)
"""Each with whether it has a primary key."""
NOT_CHANGED = (
    "SELECT relname FROM pg_class WHERE relkind = 'r' AND relnamespace = to_regnamespace('mapweave') "
    "AND relname = ANY(%s) AND NOT (SELECT bool_and(has_table_privilege(pg_class.oid, needed)) "
    "FROM unnest(ARRAY['SELECT', 'INSERT', 'UPDATE', 'DELETE']) AS needed) ORDER BY relname"
)
"""Tables that this session's user may not change."""
PREPARED_AFTER = 5
"""Uses of a statement, by a session that writes."""
VERSIONS = "schema_version"
"""The table that has the version of all others."""
SCHEMA_LOCK = 0x4D575354
"""Advisory lock of who makes the tables: 'MWST'."""


class PostgresStore(Store):
    """All logs in one database.

    One session writes, another reads: a commit that waits for a standby holds up no answer. Where PostgreSQL
    is away, every method fails with InvalidFile; the next call connects again.

    The session that reads holds the server's name: it waits for no standby, so PostgreSQL notices at once
    when its server is killed.
    """

    shared = True

    def __init__(self, address: str, name: str = "store", read_only: bool = False) -> None:
        """Connect, and make the tables if there are none.

        Args:
            address: see PostgresAddress.read.
            name: of the server, as PostgreSQL's lists of sessions show it. One server has it at a time.
            read_only: change nothing, and take no name; the tables must be there.

        Raises:
            InvalidValue: the address is none, or has a password.
            InvalidFile: there is no connection, the tables are of another version, or another server has
                this name.
        """
        super().__init__()
        self.address = PostgresAddress.read(address)
        self._write_lock, self._read_lock = threading.RLock(), threading.RLock()
        self._name, self._session_id = name, 0
        self._server_name = ServerName(name, self.address.words)
        self._has_name = False
        self._follower: PostgresFollower | None = None
        self._writing: int | None = None
        """The thread in a transaction."""
        self._touched: dict[str, None] = {}
        self._warnings: list[str] = []
        self._warned = False
        options = {"default_transaction_read_only": "on"} if read_only else {}
        self._reader, self._writer = (
            PostgresSession(self.address, self._server_name.session, options, not read_only, prepare)
            for prepare in (self._check_version if read_only else self._prepare_reader, self._prepare)
        )
        self._watchdog = PostgresWatchdog(self._reader, self._writer)
        try:
            if not read_only:
                self._take_name()
                self._make()
            self.id = int.from_bytes(self.result(ID) or b"", "big")
        except InvalidFile:
            self.close()
            raise

    @property
    def leads(self) -> bool:
        """Whether this server writes the results of merging; see `Store`."""
        return self._follower is not None and self._follower.leads

    @property
    def leader(self) -> str:
        """The server that leads; see `Store`."""
        return "" if self._follower is None else self._follower.leader

    @property
    def term(self) -> int:
        """How often this server has begun to lead; see `Store`."""
        return 0 if self._follower is None else self._follower.term

    @property
    def followed(self) -> bool:
        """Whether this server leads others; see `Store`."""
        return self._follower is not None and self._follower.followed

    def publish(self, results: Mapping[str, bytes]) -> None:
        """Have results stored soon, by the session that holds the leader's lock; see `Store`."""
        if self._follower is not None:
            self._follower.publish(results)

    @property
    def displaced(self) -> str:
        """Why this server must end; see `Store`."""
        return self._server_name.displaced

    def follow(self, changed: Callable[[News], None]) -> None:
        """Have what other servers write reported; see `Store`."""
        self._follower = PostgresFollower(
            self.address, self._name, lambda: self._session_id, changed, self._watchdog
        )

    def close(self) -> None:
        """End the sessions. Idempotent."""
        if self._follower is not None:
            self._follower.close()
        for lock, session in ((self._write_lock, self._writer), (self._read_lock, self._reader)):
            with lock:
                session.close()
        self._watchdog.close()

    def _take_name(self) -> None:
        # A pooler of transactions would keep the lock: it is found out by the second session.
        reader, _ = self._reader.connection, self._writer.connection
        self._has_name = True
        with self._reader.guard():
            self._server_name.take(reader)

    def _make(self) -> None:
        """Make the tables where there are none; servers that start together take turns."""
        with self._transaction():
            self._writer.connection.execute("SELECT pg_advisory_xact_lock(%s)", (SCHEMA_LOCK,))
            there = _tables(self._writer.connection)
            if not there:
                for statement in _statements():
                    self._writer.connection.execute(statement)
                self._put("result", (ID, fresh_id().to_bytes(8, "big")))
            else:
                self._check_version(self._writer.connection)
                self._check_rights(self._writer.connection)

    def _check_rights(self, connection: psycopg.Connection) -> None:
        """A server that may only read would serve, and acknowledge nothing."""
        if tables := [name for (name,) in connection.execute(NOT_CHANGED, ([*KEYS],))]:
            raise InvalidFile(
                f"{self.address.words}: the user may not change {', '.join(tables)}: connect as their owner, "
                "or GRANT it SELECT, INSERT, UPDATE and DELETE on them"
            )

    def _check_version(self, connection: psycopg.Connection) -> None:
        version, there = _version(connection), _tables(connection)
        # A restore fills the tables first, and then adds the keys.
        if (there and version is None) or (version == VERSION and not all(there.values())):
            raise InvalidFile(
                f"{self.address.words}: has only a part of a map store: a restore into it runs or failed; "
                "if it failed, drop this database and restore into an empty one, or use that of before"
            )
        if version is None:
            raise InvalidFile(
                f"{self.address.words}: has no map store: a map server makes one at its first start on it"
            )
        if version != VERSION:
            raise InvalidFile(
                f"{self.address.words}: has a map store of format {version}, this program uses format "
                f"{VERSION}: {what_to_do(version, VERSION)}"
            )

    def _prepare_reader(self, connection: psycopg.Connection) -> None:
        if self._has_name:
            self._server_name.take(connection)
            self._check_version(connection)

    def _prepare(self, connection: psycopg.Connection) -> None:
        """A writer's session: what is acknowledged must survive."""
        if self._has_name:
            # Both were lost, or the other one is with a primary of before.
            with self._read_lock:
                if not self._server_name.is_held(connection):
                    self._reader.renew()
        connection.add_notice_handler(self._note)
        connection.prepare_threshold = PREPARED_AFTER
        # The number that libpq knows is that of a pooler, if there is one.
        settings = connection.execute(
            "SELECT pg_backend_pid(), current_setting('synchronous_commit'), current_setting('fsync')"
        ).fetchone()
        self._session_id, synchronous, fsync = settings or (0, "", "")
        if synchronous in ("off", "local"):
            connection.execute("SET synchronous_commit = on")
        if fsync == "off" and not self._warned:
            self._warned = True
            log.warning(
                "%s: runs with fsync=off: what is acknowledged is lost with the machine's power",
                self.address.words,
            )

    def _note(self, diagnostic: psycopg.errors.Diagnostic) -> None:
        if diagnostic.severity_nonlocalized == "WARNING":
            self._warnings.append(diagnostic.message_primary or "")

    def _read(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        query = query.replace("?", "%s")
        if self._writing == threading.get_ident():
            return self._writer.connection.execute(query, values, binary=True).fetchall()
        with self._read_lock:
            was_open = self._reader.is_open
            try:
                return self._fetch(query, values)
            except InvalidFile:
                if not was_open or self._reader.is_open:
                    raise
                # The session was lost, perhaps long before: another one may be had at once.
                return self._fetch(query, values)

    def _fetch(self, query: str, values: Sequence[object]) -> list[Any]:
        with self._reader.guard():
            return self._reader.connection.execute(query, values, binary=True).fetchall()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._write_lock, self._writer.guard():
            if self.displaced:
                raise InvalidFile(self.displaced)
            self._touched.clear()
            try:
                with self._writer.connection.pipeline(), self._writer.transaction() as connection:
                    self._writing = threading.get_ident()
                    yield
                    self._notify(connection)
                    self._warnings.clear()
            finally:
                self._writing = None
            if self._warnings:
                # Committed here, but not confirmed by the standby: the wait for it was cancelled.
                raise InvalidFile(f"{self.address.words}: a commit is not confirmed ({self._warnings[0]})")
        written(self.address.words, CALM)

    def _notify(self, connection: psycopg.Connection) -> None:
        """Notify the other servers."""
        if self._touched:
            connection.execute("SELECT pg_notify(%s, %s)", (CHANNEL, words_of([*self._touched])))

    def _begin(self, runs: Sequence[LogChanges]) -> dict[MapId, Position]:
        ids = {run.map_id: str(run.log_id) for run in runs}
        # In one order everywhere: two servers that wait for each other's rows would wait for ever.
        rows = [(map_id.agent, map_id.epoch, ids[map_id]) for map_id in sorted(ids)]
        agents, epochs, log_ids = ([row[k] for row in rows] for k in range(3))
        self._writer.connection.execute(
            "INSERT INTO log SELECT *, 0 FROM unnest(%s::text[], %s::bigint[], %s::text[]) "
            "ON CONFLICT (agent, epoch) DO NOTHING",
            (agents, epochs, log_ids),
        )
        found = self._writer.connection.execute(
            "SELECT agent, epoch, log_id, watermark FROM log WHERE (agent, epoch) IN "
            "(SELECT * FROM unnest(%s::text[], %s::bigint[])) ORDER BY agent, epoch FOR UPDATE",
            (agents, epochs),
        ).fetchall()
        return {MapId(agent, epoch): Position(int(log_id), mark) for agent, epoch, log_id, mark in found}

    def _wire_bytes(self, grown: Sequence[tuple[str, int, int, int]]) -> Iterable[tuple[str, int, int]]:
        query = (
            "SELECT kind, count(*), CAST(sum(wire_bytes) AS BIGINT) FROM change JOIN "
            "unnest(CAST(? AS TEXT[]), CAST(? AS BIGINT[]), CAST(? AS BIGINT[]), CAST(? AS BIGINT[])) "
            "AS grown (agent, epoch, first, last) USING (agent, epoch) "
            "WHERE sequence > first AND sequence <= last GROUP BY kind"
        )
        return self._read(query, [list(column) for column in zip(*grown, strict=True)])

    def _lock_table(self, table: str) -> None:
        self._writer.connection.execute(f"LOCK TABLE {table} IN SHARE ROW EXCLUSIVE MODE")

    def _write(self, query: str, values: Sequence[object]) -> None:
        self._writer.connection.execute(query.replace("?", "%s"), values)

    def _put(self, table: str, values: Sequence[object]) -> None:
        # PostgreSQL's texts have no NUL, and are valid UTF-8.
        clean = [_text(value) if isinstance(value, str) else value for value in values]
        self._writer.connection.execute(INSERTS[table], clean)
        if table == "log":
            self._touched[f"{LOG}:{values[0]}.{values[1]}"] = None
        elif table in (CONSTRAINTS, ANNOTATIONS):
            self._touched[f"{RECORD}:{table}"] = None
        elif table == "result":
            # The names with spaces, of images, are not followed.
            self._touched[f"{RECORD}:{str(values[0]).replace(' ', '_')}"] = None


def _tables(connection: psycopg.Connection) -> dict[str, bool]:
    """Those of a store that are there, each with whether it has the key that it needs."""
    rows = connection.execute(TABLES_THERE).fetchall()
    return {name: has_key or name == VERSIONS for name, has_key in rows if name in (*KEYS, VERSIONS)}


def _version(connection: psycopg.Connection) -> int | None:
    there = connection.execute("SELECT to_regclass('mapweave.schema_version') IS NOT NULL").fetchone()
    if not there or not there[0]:
        return None
    row = connection.execute("SELECT version FROM mapweave.schema_version").fetchone()
    return None if row is None else int(row[0])


def _statements() -> Iterator[str]:
    yield "CREATE SCHEMA IF NOT EXISTS mapweave"
    yield "CREATE TABLE schema_version (version BIGINT NOT NULL)"
    yield f"INSERT INTO schema_version VALUES ({VERSION})"
    yield from map(_table, KEYS)
    # Bodies are as small as they get already.
    yield "ALTER TABLE change ALTER COLUMN body SET STORAGE EXTERNAL"


def _table(table: str) -> str:
    columns = [f"{name} {TYPES.get(name, 'BIGINT NOT NULL')}" for name in (*KEYS[table], *VALUES[table])]
    return f"CREATE TABLE {table} ({', '.join(columns)}, PRIMARY KEY ({', '.join(KEYS[table])}))"


def _insert(table: str) -> str:
    """A row in the place of one with the same key; a change that is stored stays as it is."""
    keys, values = KEYS[table], VALUES[table]
    marks = ", ".join(["%s"] * (len(keys) + len(values)))
    update = ", ".join(f"{name} = EXCLUDED.{name}" for name in values)
    does = "NOTHING" if table == "change" else f"UPDATE SET {update}"
    columns, key = ", ".join((*keys, *values)), ", ".join(keys)
    return f"INSERT INTO {table} ({columns}) VALUES ({marks}) ON CONFLICT ({key}) DO {does}"


INSERTS = {table: _insert(table) for table in KEYS}


def _text(value: str) -> str:
    return value.replace("\0", "\ufffd").encode("utf-8", "replace").decode()
