"""The name of a server on a store that servers share: one server has it at a time."""

import hashlib
import os
import secrets
import socket
import time
from datetime import UTC

import psycopg

from mapweave.hybridmap.errors import InvalidFile

PATIENCE = 2.0
"""How long to wait for a server that is about to end, s."""
STEP = 0.05
"""s between two attempts."""
LOCKS = (
    "WITH locks AS (SELECT pid, (classid::bigint << 32) | objid::bigint AS key FROM pg_locks "
    "WHERE locktype = 'advisory' AND objsubid = 1 AND granted "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())), "
    "holders AS (SELECT pid, pid IN (SELECT pid FROM locks WHERE key = %s) AS own FROM locks WHERE key = %s) "
)
"""The session that holds a name, and whether it is of this server. Locks are of one database."""
HELD = LOCKS + "SELECT coalesce(bool_or(own), false) FROM holders"
END_FORMER = LOCKS + "SELECT pg_terminate_backend(pid) FROM holders WHERE own"
HOLDER = LOCKS + (
    "SELECT own, pid, application_name, host(client_addr), backend_start "
    "FROM holders LEFT JOIN pg_stat_activity USING (pid)"
)


class ServerName:
    """Held by a session of this server, by an advisory lock.

    Its sessions share a second lock, by which the server knows a former one of its own: when the network was
    cut, PostgreSQL keeps that until it notices. A pooler passes a session on without its locks.

    Attributes:
        session: what PostgreSQL's lists call a session of this server.
        displaced: why this server must end, in one line: another one has taken the name. Empty until then.
    """

    def __init__(self, name: str, words: str) -> None:
        """Take note of the name.

        Args:
            name: of the server.
            words: the store, for people.
        """
        self._name, self._words = name, words
        self._prefix = f"mapweave {name}, "
        self.session = f"{self._prefix}process {os.getpid()} on {socket.gethostname()}"
        self.displaced = ""
        self._was_held = False
        digest = hashlib.blake2b(f"mapweave server {name}".encode(), digest_size=8).digest()
        # Not negative, as the locks are listed.
        self._keys = secrets.randbits(63), int.from_bytes(digest, "big") >> 1

    def take(self, connection: psycopg.Connection) -> None:
        """Have this session hold the name.

        Raises:
            InvalidFile: another server holds it. If this one held it before, it is displaced for good.
        """
        if self.displaced:
            raise InvalidFile(self.displaced)
        connection.execute("SELECT pg_advisory_lock_shared(%s)", self._keys[:1])
        end = time.monotonic() + PATIENCE
        while connection.execute("SELECT pg_try_advisory_lock(%s)", self._keys[1:]).fetchone() != (True,):
            connection.execute(END_FORMER, self._keys)
            if time.monotonic() >= end:
                self._refuse(connection)
            time.sleep(STEP)
        self._was_held = True

    def is_held(self, connection: psycopg.Connection) -> bool:
        """Whether a session of this server holds the name, where this session is connected."""
        return connection.execute(HELD, self._keys).fetchone() == (True,)

    def _refuse(self, connection: psycopg.Connection) -> None:
        """Raise with what is known of the server that holds the name; return if none does now."""
        # In a transaction PostgreSQL lists the sessions of the first look.
        connection.execute("SELECT pg_stat_clear_snapshot()")
        holder = connection.execute(HOLDER, self._keys).fetchone()
        if holder is None:
            return
        own, number, session, host, since = holder
        if own:
            raise InvalidFile(
                f"{self._words}: the map store cannot be used (PostgreSQL has not ended this server's "
                f"former session {number} yet)"
            )
        known = (session or "").startswith(self._prefix)
        who = session.removeprefix(self._prefix) if known else f"session {number} of PostgreSQL"
        # Sessions of another role are listed without these.
        who += f", connected{f' from {host}' if host else ''}" if host or since else ""
        who += f" since {since.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC" if since else ""
        if self._was_held:
            self.displaced = (
                f"{self._words}: another map server {self._name} ({who}) took this name while this one had "
                "no connection, and this one acknowledges nothing more: give one of them another --name"
            )
            raise InvalidFile(self.displaced)
        raise InvalidFile(
            f"{self._words}: a map server {self._name} runs on this store already ({who}): end it, or start "
            "this one with another --name; if that machine is gone, start again in 11 s, when PostgreSQL has "
            "noticed"
        )
