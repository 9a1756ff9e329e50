"""What other servers write to a shared store, and which of them leads."""

import logging
import threading
import time
from collections.abc import Callable, Mapping

import psycopg

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.store import EVERYTHING, LEADS, MERGE_MARK, News
from mapweave.storage.postgres_session import RETRY, PostgresAddress, PostgresSession
from mapweave.storage.postgres_watchdog import PostgresWatchdog

log = logging.getLogger(__name__)

CHANNEL = "mapweave"
"""Of the notifications about what has changed."""
MOST_NOTIFIED = 7000
"""Bytes; PostgreSQL takes less than 8000 (https://www.postgresql.org/docs/15/sql-notify.html)."""
LEADER_LOCK = 0x4D575355
"""Advisory lock of the server that leads: 'MWSU'. Locks are of one database."""
FOLLOW_LOCK = 0x4D575356
"""Shared by all servers that follow, or lead: 'MWSV'."""
SERVERS = (
    "SELECT objid, application_name FROM pg_locks LEFT JOIN pg_stat_activity USING (pid) "
    "WHERE locktype = 'advisory' AND classid = 0 AND objid IN (%s, %s) AND objsubid = 1 AND granted "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)
"""Which locks are held, by which sessions."""
PUBLISH = (
    "INSERT INTO result (name, value) VALUES (%s, %s) ON CONFLICT (name) DO UPDATE SET value = EXCLUDED.value"
)
LOG, RECORD = "log", "record"
"""With which the words of a notification begin: before the name of a map, and of a record."""
PREFIX, SUFFIX = "mapweave ", " follows"
"""Around the name of a server in the name of its session."""
BEAT = 0.5
"""s between two signs of life; so often a server tries to lead."""
FROZEN = "5s"
"""After so long without a sign of life PostgreSQL ends the session of a leader, and another leads."""
POLL = 5.0
"""s between two looks at everything: a notification may be lost with its session."""
STUCK = "10s"
"""So long a transaction of another server may wait for its server, with the logs that it has locked."""
END_STUCK = (
    "SELECT application_name, pg_terminate_backend(pid) FROM pg_stat_activity "
    "WHERE datname = current_database() AND usename = current_user AND pid <> %s "
    "AND application_name LIKE %s AND xact_start IS NOT NULL AND wait_event = 'ClientRead' "
    "AND clock_timestamp() - state_change > %s::interval"
)
"""A frozen server's; `idle_in_transaction_session_timeout` does not end transactions in a pipeline."""


class PostgresFollower:
    """A thread with a session of its own, which listens, and holds the lock."""

    def __init__(
        self,
        address: PostgresAddress,
        name: str,
        own_session: Callable[[], int],
        changed: Callable[[News], None],
        watchdog: PostgresWatchdog,
    ) -> None:
        """Begin to follow.

        Args:
            address: of the database.
            name: of the server.
            own_session: PostgreSQL's number of the session with which this server writes.
            changed: called from the thread with what others have written; at the start, at least every few
                seconds, and before this server leads, with everything.
            watchdog: gives up the session if PostgreSQL stands still.
        """
        self._own_session, self._changed = own_session, changed
        ends = dict.fromkeys(("idle_session_timeout", "idle_in_transaction_session_timeout"), FROZEN)
        self._session = PostgresSession(address, f"{PREFIX}{name}{SUFFIX}", ends, prepare=self._listen)
        watchdog.add(self._session)
        self._leads, self._leader, self._servers = False, "", 0
        self._term, self._reported = 0, (False, False, -1)
        self._results: dict[str, bytes] = {}
        self._unpublished = ""
        self._publishing = threading.Lock()
        self._failure = ""
        self._polled_at = 0.0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="follow", daemon=True)
        self._thread.start()

    @property
    def leads(self) -> bool:
        """Whether this server holds the lock, as far as it knows."""
        return self._leads

    @property
    def term(self) -> int:
        """How often this server has begun to lead."""
        return self._term

    @property
    def leader(self) -> str:
        """The server that holds the lock; empty if that is not known."""
        return self._leader

    @property
    def followed(self) -> bool:
        """Whether this server leads others, as far as it knows."""
        return self._leads and self._servers > 1

    def publish(self, results: Mapping[str, bytes]) -> None:
        """Have results stored, and the others notified, if this server leads then; see `Store.publish`."""
        with self._publishing:
            self._results |= results

    def close(self) -> None:
        """Stop; another server may lead at once. Idempotent."""
        self._stopping.set()
        self._thread.join()
        self._session.close()

    def _listen(self, connection: psycopg.Connection) -> None:
        connection.execute(f"LISTEN {CHANNEL}")
        connection.execute("SELECT pg_advisory_lock_shared(%s)", (FOLLOW_LOCK,))
        # What was written before is not notified.
        self._polled_at = 0.0

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                with self._session.guard():
                    self._follow()
                self._failure = ""
            except InvalidFile as error:
                self._lose()
                if str(error) != self._failure:
                    log.warning("%s", error)
                self._failure = str(error)
                self._stopping.wait(RETRY)
            except Exception:  # a defect with one piece of news must not end all following
                log.exception("what other servers have written could not be followed")
                self._stopping.wait(RETRY)

    def _follow(self) -> None:
        """Once: try to lead, then wait for news."""
        # Also while it is held, which changes nothing: it is the sign of life.
        with self._session.transaction() as connection:
            row = connection.execute("SELECT pg_try_advisory_lock(%s)", (LEADER_LOCK,)).fetchone()
            held = connection.execute(SERVERS, (LEADER_LOCK, FOLLOW_LOCK)).fetchall()
        holds = bool(row and row[0])
        self._servers = sum(lock == FOLLOW_LOCK for lock, _ in held)
        names = [str(name) for lock, name in held if lock == LEADER_LOCK and name]
        self._leader = names[0].removeprefix(PREFIX).removesuffix(SUFFIX) if names else ""
        if holds and not self._leads:
            self._look_at_everything()
            self._term += 1
            log.info("%s: this server leads", self._session.address.words)
        self._leads = holds
        if (now := (holds, self.followed, self._term)) != self._reported:
            self._reported = now
            self._changed(LEADS)
        self._publish()
        if time.monotonic() >= self._polled_at + POLL:
            self._end_stuck(connection)
            self._look_at_everything()
        notified = [*connection.notifies(timeout=BEAT, stop_after=1)]
        own = self._own_session(), connection.info.backend_pid
        words = [one.payload for one in notified if one.pid not in own]
        if words:
            self._changed(_news(words))

    def _publish(self) -> None:
        """Store what the leader publishes. Only this session holds the lock: no leader of before writes."""
        if not self._leads:
            self._lose()
        with self._publishing:
            results = dict(self._results)
        if not results:
            return
        try:
            with self._session.transaction() as connection:
                # It follows from the logs: nothing waits for a disk or a standby.
                connection.execute("SET LOCAL synchronous_commit = off")
                for name, value in results.items():
                    connection.execute(PUBLISH, (name, value))
                connection.execute("SELECT pg_notify(%s, %s)", (CHANNEL, f"{RECORD}:{MERGE_MARK}"))
        except psycopg.Error as error:
            if not self._session.is_open:
                raise
            # It leads all the same, and tries it again.
            if str(error) != self._unpublished:
                log.warning("a merge is not handed over: %s", " ".join(str(error).split()))
            self._unpublished = str(error)
            return
        self._unpublished = ""
        with self._publishing:
            self._results = {n: v for n, v in self._results.items() if results.get(n) is not v}

    def _lose(self) -> None:
        """This server leads no longer, and what it has not stored it never will."""
        self._leads = False
        with self._publishing:
            self._results = {}

    def _end_stuck(self, connection: psycopg.Connection) -> None:
        for name, _ in connection.execute(END_STUCK, (self._own_session(), "mapweave %", STUCK)):
            log.warning(
                "%s: ended the session of %s, which held a transaction open for %s: is that server frozen?",
                self._session.address.words,
                name,
                STUCK,
            )

    def _look_at_everything(self) -> None:
        self._changed(EVERYTHING)
        self._polled_at = time.monotonic()


def words_of(touched: list[str]) -> str:
    """A notification's text; empty: everything may have changed."""
    words = " ".join(touched)
    return words if len(words.encode()) < MOST_NOTIFIED else ""


def _news(payloads: list[str]) -> News:
    if "" in payloads:
        return EVERYTHING
    maps, records = set[MapId](), set[str]()
    for word in (word for payload in payloads for word in payload.split(" ")):
        kind, _, value = word.partition(":")
        if kind == LOG:
            agent, _, epoch = value.rpartition(".")
            maps.add(MapId(agent, int(epoch)))
        else:
            records.add(value)
    return News(frozenset(maps), frozenset(records))
