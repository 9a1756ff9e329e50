"""Whether it is worth waiting for a PostgreSQL that cannot be reached.

libpq tells no code of why a connection was refused, and words depend on the language of the server. Its
`PQping`, which `pg_isready` uses, does know: whether nothing answers, whether PostgreSQL starts, ends or
recovers, or whether it takes sessions, and then refuses this one for another reason.
"""

from __future__ import annotations

import psycopg
from psycopg import pq
from psycopg.conninfo import make_conninfo

from mapweave.storage.postgres_session import PostgresAddress


def waiting_may_help(address: PostgresAddress) -> bool:
    """Whether a database that could not be reached may be reached later, with all set up as it is.

    Not with a wrong password, user or database name. Takes up to twice the time for a connection.

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
        return False
    # It came just now, or there are standbys only: one of them becomes the primary.
    return True
