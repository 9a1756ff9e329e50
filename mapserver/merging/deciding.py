"""Decides large maps again as a whole, by a thread beside the one that merges."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from mapserver.merging.merger import Merger

log = logging.getLogger(__name__)


class Deciding:
    """One map at a time. Only the merging thread may begin it."""

    def __init__(self, merger: Merger, tell: Callable[[bool], None]) -> None:
        """Nothing is decided again yet.

        Args:
            merger: says what should be.
            tell: is told, from any thread, that it is done: whether it went well.
        """
        self._merger, self._tell = merger, tell

    def begin(self) -> None:
        """Decide again what should be, if anything; returns at once."""
        if (decide := self._merger.again()) is not None:
            threading.Thread(target=self._decide, args=(decide,), name="decide", daemon=True).start()

    def _decide(self, decide: Callable[[], None]) -> None:
        began = time.monotonic()
        try:
            decide()
        except Exception:  # steps go on from what stands
            log.exception("the merged map could not be decided again as a whole")
            self._tell(False)
            return
        log.info("the merged map is decided again as a whole, in %.0f s", time.monotonic() - began)
        self._tell(True)
