"""Puts the next changes of many logs on the disk in one transaction.

A commit waits for the disk, a few milliseconds whatever is in it: one for each log takes in two or three
hundred changes a second, one for all that wait takes in thousands.
"""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from mapweave.hybridmap.errors import InvalidFile, MapweaveError
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.entry import Applied, ReceivedChange
from mapweave.mapserver.log.intake import Full, Intakes
from mapweave.mapserver.log.store import LogChanges, Store

log = logging.getLogger(__name__)

LONG = 5.0
"""s after which a commit that waits is reported: one that takes longer waits for more than a busy disk."""
WAITS = "a commit waits: the disk does not answer, or no standby of PostgreSQL confirms"


@dataclass(frozen=True, slots=True)
class NextRun:
    """The next changes of a log.

    Attributes:
        log: whose.
        entries: in order.
        covered: the agent has nothing else up to here; None: nothing is missing between the entries.
        full: why the robot's quota has room for no more; None if it has.
    """

    log: AgentLog
    entries: Sequence[ReceivedChange]
    covered: int | None = None
    full: Full | None = None


class GroupCommit:
    """Commits what is within the quotas, and keeps each log's failure to itself."""

    def __init__(self, store: Store, intakes: Intakes) -> None:
        self._store, self._intakes = store, intakes
        self._since: float | None = None

    @property
    def delay(self) -> str:
        """What holds up the commit that is under way, if it waits too long; from any thread."""
        since = self._since
        return WAITS if since is not None and time.monotonic() - since > LONG else ""

    def fitting(self, run: NextRun) -> NextRun:
        """What the robot's quota has room for of a run.

        Raises:
            InvalidFile: the store cannot be read.
        """
        fits, full = self._intakes.of(run.log.map.agent).fitting(run.log.map, run.entries)
        if full is None:
            return run
        covered = None if run.covered is None else run.entries[fits].sequence - 1
        return replace(run, entries=run.entries[:fits], covered=covered, full=full)

    def commit(self, runs: Sequence[NextRun]) -> list[Applied | MapweaveError]:
        """Put runs of different logs on the disk.

        Returns:
            For each what is new, or why nothing of it is on the disk.
        """
        stored = [LogChanges(run.log.map, run.log.log_id, run.entries, run.covered) for run in runs]
        results = self._apply(stored)
        if len(runs) > 1 and all(isinstance(result, InvalidFile) for result in results):
            # One that the disk does not take must not hold up the others.
            results = [result for run in stored for result in self._apply([run])]
        return results

    def _apply(self, runs: Sequence[LogChanges]) -> list[Applied | MapweaveError]:
        self._since = time.monotonic()
        try:
            return self._store.apply_all(runs)
        except Exception as error:  # a defect with one log must not end the ingest of all
            if len(runs) == 1:
                log.exception("changes of %s cannot be stored", runs[0].map_id)
            names = ", ".join(str(run.map_id) for run in runs)
            return [
                InvalidFile(f"changes of {names} cannot be stored ({type(error).__name__})") for _ in runs
            ]
        finally:
            self._since = None
