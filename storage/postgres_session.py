"""A session with PostgreSQL: connects again when it was lost, and reports errors in one line."""

from __future__ import annotations

import logging
import os
import re
import secrets
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import psycopg
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from mapweave.hybridmap.errors import InvalidFile, InvalidValue, StoreAway
from mapweave.storage.full_disks import FullDisk
from mapweave.storage.os_errors import reason_of

SCHEME = "postgresql://"
EXAMPLE = "postgresql://USER@HOST/DATABASE"
CONNECT_TIMEOUT = 3
"""For one host, s."""
RETRY = 1.0
"""s after a failed attempt before the next: what asks meanwhile gets the same error at once."""
OPTIONS = {
    # What is looked for is this program's own, whatever else is in the database.
    "search_path": "mapweave",
    # A frozen process must not hold up other servers on the same record. No time is measured in a pipeline.
    "idle_in_transaction_session_timeout": "10s",
    "lock_timeout": "5s",
    # A machine that lost its power says no goodbye: its session, with all locks, ends after some 11 s.
    "tcp_keepalives_idle": "5s",
    "tcp_keepalives_interval": "2s",
    "tcp_keepalives_count": "3",
    "tcp_user_timeout": "11s",
}
"""Of each session, at PostgreSQL's side. Set once it is connected: pgbouncer takes none before."""
KEEPALIVE = {
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 11_000,
}
"""The same at this side."""
CLAIM = (
    "SELECT set_config('mapweave.session', "
    "coalesce(nullif(current_setting('mapweave.session', true), ''), %s), false)"
)
"""Marks a session that has no mark; returns the mark that it has then."""
SET = "SELECT set_config(name, value, false) FROM unnest(%s::text[], %s::text[]) AS one (name, value)"
OWN = "SELECT 1 / (current_setting('mapweave.session', true) IS NOT DISTINCT FROM %s)::int"
"""Fails without this mark, and with it what follows in its transaction: no answer has to be waited for."""
SHARED = (
    "a pooler gives one session to several clients: in pgbouncer set pool_mode = session and "
    "server_reset_query = DISCARD ALL, or name PostgreSQL's own port"
)
ATTEMPT = re.compile(r" ?- host: (?:'(.*?)'|None), port: (?:'(.*?)'|None), hostaddr: (?:'.*?'|None): ")
"""What psycopg writes before the reason why one of several hosts is not connected."""
NOISE = re.compile(
    r"^connection failed: |(?:connection|connection to server) (?:at|on) .*? failed: "
    r"| Is the server running .*?\?"
)
"""What libpq says around a reason, when host and port are named already."""
LOST = re.compile(
    r"^consuming input failed: | This probably means the server terminated abnormally before or while .*\."
)
"""And around one that says all: the server closed the connection unexpectedly."""
NO_PASSWORD = "no password supplied"

# It logs what it ignores when a connection is lost; the error itself is raised and reported.
logging.getLogger("psycopg").setLevel(logging.ERROR)


@dataclass(frozen=True)
class PostgresAddress:
    """Where a database is.

    Attributes:
        parameters: of libpq. No password is among them.
        words: for people.
    """

    parameters: dict[str, Any]
    words: str

    @staticmethod
    def read(text: str) -> PostgresAddress:
        """Read what a person wrote.

        Raises:
            InvalidValue: it is no address, or has a password. The message does not repeat it.
        """
        try:
            parameters = dict(conninfo_to_dict(text))
        except psycopg.ProgrammingError:
            parameters = {"port": "none"}
        # Where a password has a slash or a colon, parts of it are read as a port and a database. libpq quotes
        # them in its errors, and this message quotes nothing.
        port, database = (str(parameters.get(name) or "") for name in ("port", "dbname"))
        if set(port) - set("0123456789,") or "@" in database:
            raise InvalidValue(f"the store's address cannot be read; it is written {EXAMPLE}")
        if parameters.keys() & {"password", "sslpassword"}:
            raise InvalidValue(
                "the store's address has a password, which others on this machine can read: leave it out, "
                "and put it into the file ~/.pgpass (or PGPASSFILE), or name a service file's entry"
            )
        if parameters.keys() & {"options"}:
            raise InvalidValue(
                "the store's address has `options`, which Mapweave sets itself: leave them out"
            )
        host = parameters.get("host") or parameters.get("service") or "localhost"
        places = _places(str(host).split(","), port.split(","))
        return PostgresAddress(parameters, f"{SCHEME}{','.join(places)}/{parameters.get('dbname', '')}")

    def conninfo(self, name: str, writes: bool) -> str:
        """The address for libpq.

        Args:
            name: of the session, as PostgreSQL's lists show it.
            writes: of several hosts connect to the one that takes changes.
        """
        defaults: dict[str, Any] = {"connect_timeout": CONNECT_TIMEOUT, "application_name": name, **KEEPALIVE}
        # Texts of a database without an encoding, which initdb makes without a locale, would come as bytes.
        defaults["client_encoding"] = "UTF8"
        if writes:
            defaults["target_session_attrs"] = "read-write"
        return make_conninfo("", **(defaults | self.parameters))


class PostgresSession:
    """One connection at a time. Threads take turns: it is used under the caller's lock.

    Locks, notifications and settings are PostgreSQL's session's. A pooler that gives each transaction another
    session loses them, so two servers could hold the same lock. So a session is marked, and one with
    another's mark is not used.
    """

    def __init__(
        self,
        address: PostgresAddress,
        name: str,
        options: dict[str, str] | None = None,
        writes: bool = True,
        prepare: Callable[[psycopg.Connection], None] = lambda connection: None,
    ) -> None:
        """Take note of the address; the first use connects.

        Args:
            address: of the database.
            name: of the session, as PostgreSQL's lists show it.
            options: settings at PostgreSQL's side, besides those of every session.
            writes: of several hosts connect to the one that takes changes.
            prepare: called with each new connection, in a transaction.
        """
        self.address = address
        self._conninfo = address.conninfo(name, writes)
        self._options = OPTIONS | (options or {})
        self._prepare = prepare
        self._mark = ""
        self._connection: psycopg.Connection | None = None
        self._socket: socket.socket | None = None
        """The connection's, once more: it is still open when another thread ends what it carries."""
        self._uses, self._used_since = 0, 0.0
        self._place, self._given_up = "", False
        self._failure, self._retry_at = "", 0.0
        self._closed = False

    @property
    def used_since(self) -> float | None:
        """Since when it is in use, s of the monotonic clock; None if it is not. From any thread."""
        since = self._used_since
        return since if self._uses else None

    @property
    def machine(self) -> str:
        """The one of the address's hosts, for libpq, that it is connected to; empty if it is to none.

        From any thread.
        """
        connection = self._connection
        try:
            if connection is None or connection.closed:
                return ""
            at = connection.info
            address = at.hostaddr or None
            return make_conninfo(
                self._conninfo, host=at.host, hostaddr=address, port=at.port, target_session_attrs="any"
            )
        except psycopg.Error:
            return ""  # it was closed just now

    def give_up(self) -> None:
        """End the connection, from any thread: what waits for an answer gets an error."""
        end = self._socket
        self._given_up = True
        with suppress(OSError):
            if end is not None:
                end.shutdown(socket.SHUT_RDWR)

    @property
    def is_open(self) -> bool:
        """Whether there is a connection that is not known to be broken."""
        return self._connection is not None and not self._connection.closed

    @property
    def connection(self) -> psycopg.Connection:
        """That of now, or a new one.

        Raises:
            InvalidFile: there is none to be had.
        """
        if self._connection is not None and not self._connection.closed:
            return self._connection
        if self._closed:
            raise InvalidFile(f"{self.address.words}: the map store is closed")
        if time.monotonic() < self._retry_at:
            raise InvalidFile(self._failure)
        try:
            with self.guard():
                # A prepared statement is known by a number: with a pooler it could be another session's. Who
                # uses transactions of `transaction` only may prepare some.
                self._connection = psycopg.connect(self._conninfo, autocommit=True, prepare_threshold=None)
                self._socket = socket.socket(fileno=os.dup(self._connection.pgconn.socket))
                at = self._connection.info
                (self._place,) = _places([at.host], [str(at.port)])
                self._given_up = False
                with self._connection.transaction():
                    self._claim(self._connection)
                    self._prepare(self._connection)
        except InvalidFile as error:
            self._drop()
            self._failure, self._retry_at = str(error), time.monotonic() + RETRY
            raise
        except BaseException as error:
            # It has no mark and no settings yet: nothing may use it.
            self._drop()
            if not isinstance(error, OSError):
                raise
            self._failure, self._retry_at = str(self._unusable(reason_of(error))), time.monotonic() + RETRY
            raise InvalidFile(self._failure) from None
        return self._connection

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Turn PostgreSQL's errors into InvalidFile with one line; what is broken is not used again.

        Raises:
            StoreAway: there is no connection, or it was lost.
            InvalidFile: any other error.
        """
        if not self._uses:
            self._used_since = time.monotonic()
        self._uses += 1
        try:
            yield
        except psycopg.Error as error:
            reason, full = _reason(error), isinstance(error, psycopg.errors.DiskFull)
            away = self._connection is None or self._connection.broken
            if self._connection is not None and self._connection.broken:
                if self._given_up:
                    reason = f"{self._place}: PostgreSQL answers nothing"
                self._drop()
            unusable, address = self._unusable(reason, StoreAway if away else InvalidFile), self.address.words
            raise FullDisk.of_database(str(unusable), address) if full else unusable from None
        finally:
            self._uses -= 1

    @contextmanager
    def transaction(self) -> Iterator[psycopg.Connection]:
        """A transaction, which fails where a pooler has given it another session.

        Raises:
            InvalidFile: there is no connection.
            psycopg.Error: anything else, see `guard`.
        """
        connection = self.connection
        with connection.transaction():
            connection.execute(OWN, (self._mark,), prepare=False)
            yield connection

    def renew(self) -> None:
        """Connect again.

        Raises:
            InvalidFile: there is no connection to be had.
        """
        self._drop()
        _ = self.connection

    def close(self) -> None:
        """End the connection for good. Idempotent."""
        self._closed = True
        self._drop()

    def _claim(self, connection: psycopg.Connection) -> None:
        self._mark = secrets.token_hex(8)
        row = connection.execute(CLAIM, (self._mark,)).fetchone()
        if row is None or row[0] != self._mark:
            raise self._unusable(SHARED)
        connection.execute(SET, ([*self._options], [*self._options.values()]))

    def _unusable(self, reason: str, kind: type[InvalidFile] = InvalidFile) -> InvalidFile:
        return kind(f"{self.address.words}: the map store cannot be used ({reason})")

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        end, self._socket = self._socket, None
        if connection is not None:
            with suppress(psycopg.Error):
                connection.close()
        if end is not None:
            end.close()


def _places(hosts: list[str], ports: list[str]) -> list[str]:
    """Each host with its port where one is given; a single port is that of all hosts."""
    ports = ports * len(hosts) if len(ports) == 1 else ports
    named = [f"[{host}]" if ":" in host else host for host in hosts]
    return [f"{host}:{port}" if port else host for host, port in zip(named, ports, strict=False)]


def _reason(error: psycopg.Error) -> str:
    """An error in one line; of several hosts, each with its reason."""
    if isinstance(error, psycopg.errors.LockNotAvailable):
        return "another session holds what is to be changed; perhaps it waits for a standby"
    if isinstance(error, psycopg.errors.DivisionByZero):
        return SHARED
    reason = LOST.sub("", " ".join(str(error).split()))
    if reason.endswith(NO_PASSWORD):
        reason += ": ~/.pgpass (PGPASSFILE) has none for this host, port, database and user"
    _, *attempts = ATTEMPT.split(reason)
    hosts, ports, reasons = attempts[::3], attempts[1::3], attempts[2::3]
    if not reasons:
        return reason
    words = [
        f"{place}: {NOISE.sub('', why).strip()}"
        for host, port, why in zip(hosts, ports, reasons, strict=True)
        for place in _places([host or "localhost"], [port or ""])
    ]
    return "; ".join(dict.fromkeys(words))
