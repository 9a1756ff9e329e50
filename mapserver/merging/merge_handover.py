"""The server that leads hands its merges over to those that follow it, in a small share of its time."""

import logging
import math
from collections.abc import Callable, Mapping

from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.stored_merges import StoredMerges

log = logging.getLogger(__name__)

SHARE, QUICK = 0.05, 0.05
"""Of the time that it may take to hand merges over, where one takes longer than so many seconds."""

MOST_WORDS = 1000
"""Characters of an event in a status message, and of a trouble that other servers hear of."""


class MergeHandover:
    """Only the merging thread may call it."""

    def __init__(self, stored: StoredMerges, clock: Callable[[], float]) -> None:
        """Nothing is handed over yet.

        Args:
            stored: writes into the store that the servers share.
            clock: the time, s.
        """
        self._stored, self._clock = stored, clock
        self._term, self._merges = 0, 0
        self._next_at = -math.inf
        self._trouble = ""

    def lead(self) -> None:
        """This server leads: what others have written before is not gone on with."""
        if self._term != self._stored.store.term:
            self._term, self._merges = self._stored.store.term, -1
            self._stored.begin()

    def write(
        self, merger: Merger, last: Mapping[MapId, int], pruning: bytes | None, outdated: bool, trouble: str
    ) -> float | None:
        """Hand the newest merge over, if others follow and it is time.

        Args:
            merger: has merged.
            last: the last change of each log that it has.
            pruning: mark of what was pruned.
            outdated: something has changed since it merged: the next merge is handed over.
            trouble: why it cannot merge, for the others to say; empty: it can.

        Returns:
            How long to wait until it is time, s; None: nothing is left to do.
        """
        if not self._stored.store.followed:
            return None
        self._stored.tell(trouble or self._trouble)
        merges = merger.counters.merges
        if merges == self._merges:
            return None
        began = self._clock()
        if began < self._next_at:
            return self._next_at - began
        if not outdated:
            try:
                self._stored.write(merger, last, pruning)
                self._trouble = ""
            except Exception as error:  # the next merge is the next chance
                log.exception("a merge is not handed over")
                words = f"a merge cannot be handed over ({type(error).__name__}: {error})"
                self._trouble = words[:MOST_WORDS]
            self._stored.tell(trouble or self._trouble)
            self._merges = merges
            took = self._clock() - began
            if took > QUICK:
                self._next_at = self._clock() + took / SHARE
        return None
