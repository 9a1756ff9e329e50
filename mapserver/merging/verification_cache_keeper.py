"""Keeps the results of comparing nodes on the disk next to the store."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.verification_cache import VerificationCache
from mapweave.mapserver.merging.verification_cache_file import load, save

log = logging.getLogger(__name__)

SUFFIX = ".verdicts"
"""Of the file, behind the store's name."""
SHARE = 0.05
"""Of the time that it may take to save."""
WORTHWHILE = 0.02
"""Share of the pairs that must be new before a running server saves them."""
RETRY = 60.0
"""After a file that could not be written, s: a full disk stays full for long."""


class VerificationCacheKeeper:
    """Loads the cache at the start, and saves it after merges. Only the merging thread may call it."""

    def __init__(self, path: Path, fresh: bool = False, clock: Callable[[], float] = time.monotonic) -> None:
        """Take note of where they lie.

        Args:
            path: of the store's file; the cache is next to it.
            fresh: the store is new: a missing cache is not reported.
            clock: the time, s.
        """
        self._clock = clock
        self._path = path.with_name(path.name + SUFFIX)
        self._fresh = fresh
        self._saved: tuple[int, int] = (0, 0)
        self._rest_until = 0.0
        self._failure = ""

    def restore(self, merger: Merger) -> None:
        """Load the results for a new merger, if the file is there and valid."""
        began = self._clock()
        try:
            findings = load(self._path, _made_by(merger))
        except InvalidFile as error:
            if self._path.exists() or not self._fresh:
                log.info("nodes are compared again: %s", error)
            findings = VerificationCache()
        else:
            log.info(
                "%d nodes were compared with each other before, %d pairs; %.1f s",
                len(findings.prints), len(findings), self._clock() - began,
            )  # fmt: skip
        merger.recollect(findings)
        self._saved = len(findings.prints), len(findings)

    def save(self, merger: Merger, last: bool = False) -> None:
        """Save them, if that is worth while.

        Args:
            merger: has compared nodes.
            last: there is no later call: save anything new.
        """
        if merger.recollecting:
            return  # The file has more than this process yet.
        now, least = merger.compared, 0.0 if last else WORTHWHILE
        new = max(abs(count - before) for count, before in zip(now, self._saved, strict=True))
        if not new or new < least * max(now) or (self._clock() < self._rest_until and not last):
            return
        began = self._clock()
        try:
            save(self._path, merger.findings(), _made_by(merger))
        except InvalidFile as error:
            if str(error) != self._failure:
                log.warning("%s; the next start takes longer", error)
            self._failure, self._rest_until = str(error), self._clock() + RETRY
            return
        self._saved, self._failure = now, ""
        self._rest_until = self._clock() + (self._clock() - began) / SHARE


def _made_by(merger: Merger) -> str:
    return f"{version('mapweave')} {merger.settings}"
