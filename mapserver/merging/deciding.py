"""Decides large maps again as a whole, beside the job that merges."""

from __future__ import annotations

import logging
from collections.abc import Callable

from mapserver.merging.merger import Merger
from mapserver.schedule import Schedule

log = logging.getLogger(__name__)


class Deciding:
    """One map at a time. Only the merging job may begin it."""

    def __init__(self, merger: Merger, schedule: Schedule, tell: Callable[[bool], None]) -> None:
        """Nothing is decided again yet.

        Args:
            merger: says what should be.
            schedule: runs the work.
            tell: is told, from any thread, that it is done: whether it went well.
        """
        self._merger, self._schedule, self._tell = merger, schedule, tell

    def begin(self) -> None:
        """Decide again what should be, if anything; returns at once."""
        if (decide := self._merger.again()) is not None:
            self._schedule.spawn(lambda: self._decide(decide))

    def _decide(self, decide: Callable[[], None]) -> None:
        began = self._schedule.monotonic()
        try:
            decide()
        except Exception:  # steps go on from what stands
            log.exception("the merged map could not be decided again as a whole")
            self._tell(False)
            return
        seconds = self._schedule.monotonic() - began
        log.info("the merged map is decided again as a whole, in %.0f s", seconds)
        self._tell(True)
