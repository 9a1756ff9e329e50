"""Keeps comparisons of nodes, and what is superseded, on the disk next to the store for the next start."""

import logging
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.merging import restart_record_file
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.restart_record import RestartRecord
from mapweave.mapserver.merging.verification_cache import VerificationCache
from mapweave.mapserver.merging.verification_cache_file import load, save
from mapweave.storage.full_disks import logged

log = logging.getLogger(__name__)

VERSION = version("mapweave")
"""Read once: it is in a file, and a process may be able to open no more."""

SUFFIX = ".verdicts"
"""Of the file, behind the store's name."""
RECORD_SUFFIX = ".superseded"
"""Of the other file."""
SHARE = 0.05
"""Of the time that it may take to save."""
QUICK = 0.05
"""s, in which what is superseded is written on most disks. Where it takes longer, acknowledgements would wait
for the disk."""
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
        self._record_path = path.with_name(path.name + RECORD_SUFFIX)
        self._fresh = fresh
        self._saved: tuple[int, int] = (0, 0)
        self._rest_until = 0.0
        self._record: RestartRecord | None = None
        self._merges = 0
        self._record_rest_until = 0.0
        self._failures: dict[str, tuple[str, float]] = {}

    def restore(self, merger: Merger) -> None:
        """Load the results for a new merger, if the file is there and valid."""
        began = self._clock()
        try:
            findings = load(self._path, made_by(merger))
        except InvalidFile as error:
            if self._path.exists() or not self._fresh:
                log.info("nodes are compared again: %s", error)
            findings = VerificationCache()
        else:
            log.info(
                "%d nodes were compared with each other before, %d pairs; %.1f s",
                len(findings.prints), len(findings), self._clock() - began,
            )  # fmt: skip
        try:
            self._record = restart_record_file.load(self._record_path, made_by(merger))
        except InvalidFile as error:
            # Files of another version are reported once.
            if self._record_path.exists() and findings.prints:
                log.info("what is superseded is decided again: %s", error)
        merger.recollect(findings, self._record)
        self._saved = len(findings.prints), len(findings)

    def save(self, merger: Merger, last: bool = False) -> None:
        """Save them, if that is worth while, and what is superseded if there was a merge.

        Args:
            merger: has compared nodes.
            last: there is no later call: save anything new.
        """
        if merger.recollecting:
            return  # The files have more than this process yet.
        self._save_findings(merger, last)
        # It is small: a server that is killed goes on from its last merge.
        if merger.counters.merges != self._merges and (self._clock() >= self._record_rest_until or last):
            self._save_record(merger, last)

    def _save_findings(self, merger: Merger, last: bool) -> None:
        now, least = merger.compared, 0.0 if last else WORTHWHILE
        new = max(abs(count - before) for count, before in zip(now, self._saved, strict=True))
        if not new or new < least * max(now) or (self._clock() < self._rest_until and not last):
            return
        began, words = self._clock(), "the next start takes longer"
        if self._tried(lambda: save(self._path, merger.findings(), made_by(merger)), words, last):
            merger.findings_kept()
            self._saved = now
            self._rest_until = self._clock() + (self._clock() - began) / SHARE

    def _save_record(self, merger: Merger, last: bool) -> None:
        began, words = self._clock(), "the next start may supersede other nodes"
        record = merger.record()
        if record == self._record or self._tried(
            lambda: restart_record_file.save(self._record_path, record, made_by(merger)), words, last
        ):
            self._record, self._merges = record, merger.counters.merges
            if (took := self._clock() - began) > QUICK:
                self._record_rest_until = self._clock() + took / SHARE

    def _tried(self, write: Callable[[], None], otherwise: str, last: bool) -> bool:
        """Write a file, but not soon after a failure; whether it was written."""
        failure, rest_until = self._failures.get(otherwise, ("", 0.0))
        if self._clock() < rest_until and not last:
            return False
        try:
            write()
        except InvalidFile as error:
            if not logged(error) and str(error) != failure:
                log.warning("%s; %s", error, otherwise)
            self._failures[otherwise] = str(error), self._clock() + RETRY
            return False
        self._failures.pop(otherwise, None)
        return True


def made_by(merger: Merger) -> str:
    """Settings and version of what merges, in words."""
    return f"{VERSION} {merger.settings}"
