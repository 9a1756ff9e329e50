"""Keeps the place index on the disk beside the store, now and then and when the server stops."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.retrieval.index_file import load, save
from mapweave.mapserver.retrieval.place_index import PlaceIndex

log = logging.getLogger(__name__)

SUFFIX = ".places"
"""Of the file, behind the store's name."""
EVERY = 600.0
"""Seconds between two looks whether there is something new to save."""
WORTHWHILE = 0.02
"""Share of the nodes that must be new before a running server saves the index."""


class PlaceIndexKeeper:
    """Brings the index back at the start, as far as the store still says the same, and saves it."""

    def __init__(self, store: Store, path: Path) -> None:
        """Read the file, if it is there and fits the store.

        Args:
            store: says what is true.
            path: of the store's file; the index lies beside it.
        """
        self._store, self._path = store, path.with_name(path.name + SUFFIX)
        self.index = self._restored()
        self._saved = self.index.version

    def look(self) -> None:
        """Save the index if that is worth while; called every so many seconds."""
        (before, _), (now, nodes) = self._saved, self.index.version
        # A large index is not written for a few nodes: they are soon put in again.
        if now - before >= WORTHWHILE * nodes:
            self._save()

    def close(self) -> None:
        """Save for the last time; nobody may add to the index any more."""
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
