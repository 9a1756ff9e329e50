"""Sessions with a PostgreSQL that stands still are given up.

A machine that is gone is noticed by TCP. Processes that are stopped, or that a disk does not answer, are not:
the machine's kernel confirms all that comes, and a session waits for as long as they stand still, also while
another machine has long been the primary. A commit that waits for a standby looks the same from here, and
must go on waiting. So another connection is made to the same machine: a PostgreSQL that runs takes or
refuses it.
"""

import threading
import time

import psycopg

from mapweave.storage.postgres_session import CONNECT_TIMEOUT, PostgresSession

LOOK = 1.0
"""s between two looks at the sessions."""
LONG = 5.0
"""s of waiting after which PostgreSQL is asked, and asked again: as long as a lock may be waited for."""


class PostgresWatchdog:
    """A thread that looks at some sessions."""

    def __init__(self, *sessions: PostgresSession) -> None:
        self._sessions = [*sessions]
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="database watchdog", daemon=True)
        self._thread.start()

    def add(self, session: PostgresSession) -> None:
        """Look at this one, too."""
        self._sessions.append(session)

    def close(self) -> None:
        """Stop. Idempotent."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        pause = LOOK
        while not self._stopping.wait(pause):
            end = time.monotonic() - LONG
            used = [(one.machine, one.used_since) for one in self._sessions]
            late = {at for at, since in used if at and since is not None and since < end}
            still = {at for at in late if stands_still(at)}
            for one in self._sessions:
                # Also those that are not in use: the next use would wait as long again.
                if one.machine in still:
                    one.give_up()
            pause = LONG if late else LOOK


def stands_still(machine: str) -> bool:
    """Whether a PostgreSQL neither takes nor refuses a connection."""
    try:
        psycopg.connect(machine, connect_timeout=CONNECT_TIMEOUT).close()
    except psycopg.errors.ConnectionTimeout:
        return True
    except psycopg.Error:
        return False
    return False
