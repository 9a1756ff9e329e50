"""Whether it is worth waiting for a PostgreSQL that cannot be reached.

libpq passes on no code of why a connection was refused, and words depend on the language of the server. Its
`PQping`, which `pg_isready` uses, does know: whether nothing answers, whether PostgreSQL starts, ends or
recovers, or whether it takes sessions, and then refuses this one for another reason. The code of that is in
what libpq traces.
"""

import os
import re
import select
import sys
import time

import psycopg
from psycopg import pq
from psycopg.conninfo import make_conninfo

from mapweave.storage.postgres_session import CONNECT_TIMEOUT, PostgresAddress

PASSING = (b"53", b"57")
"""Classes of codes that pass by themselves: too many sessions or too little memory, and an operator who ends
or starts PostgreSQL (https://www.postgresql.org/docs/15/errcodes-appendix.html)."""
REFUSED = re.compile(rb'\tErrorResponse\t.*? C "(\w{5})" M "')
"""A refusal with its code, in a trace."""


def waiting_may_help(address: PostgresAddress) -> bool:
    """Whether a database that could not be reached may be reached later, with all set up as it is.

    Not with a wrong password, user or database name. Takes up to three times the time for a connection.

    Args:
        address: just now it could not be connected.
    """
    conninfo = make_conninfo(address.conninfo("mapweave", writes=False), target_session_attrs="any")
    answer = pq.Ping(pq.PGconn.ping(conninfo.encode()))
    if answer is not pq.Ping.OK:
        return answer is not pq.Ping.NO_ATTEMPT
    try:
        psycopg.connect(conninfo).close()
    except psycopg.errors.ConnectionTimeout:
        # A pooler is there, and its PostgreSQL is not.
        return True
    except psycopg.Error:
        return any(code.startswith(PASSING) for code in _refusals(conninfo))
    # It came just now, or there are standbys only: one of them becomes the primary.
    return True


def _refusals(conninfo: str) -> list[bytes]:
    """The codes (SQLSTATE) with which an attempt to connect is refused, one for each machine that does.

    None where libpq cannot trace, which psycopg does on Linux only.
    """
    if sys.platform != "linux":
        return []
    attempt = pq.PGconn.connect_start(conninfo.encode())
    # In memory: a trace has what is sent, so the password as well.
    trace = os.memfd_create("trace")
    try:
        attempt.trace(trace)
        end = time.monotonic() + CONNECT_TIMEOUT
        while (state := attempt.connect_poll()) in (pq.PollingStatus.READING, pq.PollingStatus.WRITING):
            waits = [attempt.socket]
            reading, writing = (waits, []) if state == pq.PollingStatus.READING else ([], waits)
            if not any(select.select(reading, writing, [], max(end - time.monotonic(), 0.0))):
                break
        attempt.untrace()
        return REFUSED.findall(os.pread(trace, os.fstat(trace).st_size, 0))
    finally:
        attempt.finish()
        os.close(trace)
