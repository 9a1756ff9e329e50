"""Keeps the place index on the disk beside the store, now and then and when the server stops."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from hybridmap.errors import InvalidFile
from mapserver.log.store import Store
from mapserver.places.placeindex import PlaceIndex
from mapserver.places.snapshot import load, save

log = logging.getLogger(__name__)

SUFFIX = ".places"
"""Of the file, behind the store's name."""
EVERY = 600.0
"""Seconds between two looks whether there is something new to save."""
WORTHWHILE = 0.02
"""Share of the nodes that must be new before a running server saves the index."""


class PlaceKeeper:
    """Brings the index back at the start, as far as the store still says the same, and saves it."""

    def __init__(self, store: Store, path: Path, every: float = EVERY) -> None:
        """Read the file, if it is there and fits the store.

        Args:
            store: says what is true.
            path: of the store's file; the index lies beside it.
            every: seconds between two looks.
        """
        self._store, self._path, self._every = store, path.with_name(path.name + SUFFIX), every
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="places", daemon=True)
        self.index = self._restored()
        self._saved = self.index.version

    def start(self) -> None:
        """Begin to save now and then."""
        self._thread.start()

    def close(self) -> None:
        """Save for the last time; nobody may add to the index any more."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._save()

    def _restored(self) -> PlaceIndex:
        began, logs = time.monotonic(), self._store.positions()
        try:
            index = load(self._path, logs)
        except InvalidFile as error:
            if logs:
                log.info("the place index is made anew: %s", error)
            return PlaceIndex()
        gone = index.retain(self._store.present())
        log.info(
            "the place index of %d nodes is as it was saved; %d are gone; %.1f s",
            len(index), gone, time.monotonic() - began,
        )  # fmt: skip
        return index

    def _work(self) -> None:
        while not self._stop.wait(self._every):
            (before, _), (now, nodes) = self._saved, self.index.version
            # A large index is not written for a few nodes: they are soon put in again.
            if now - before >= WORTHWHILE * nodes:
                self._save()

    def _save(self) -> None:
        state = self.index.version
        if state == self._saved:
            return
        try:
            # The logs first: what comes meanwhile may be in the index, but is not claimed.
            save(self._path, self.index, self._store.positions())
        except InvalidFile as error:
            log.warning("%s; the next start takes longer", error)
            return
        self._saved = state
