"""Keeps the answers up to date: a thread of its own takes changes in and makes the merged map anew."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Iterable

from hybridmap.change import Change
from hybridmap.errors import MapweaveError
from hybridmap.ruling import Rulings
from mapserver.answers import Answers
from mapserver.merger import Merger, MergerSettings
from mapserver.placeindex import PlaceIndex
from merge.merged import MergedMap
from merge.merging import MergeSettings
from merge.parting import joinings, partings

log = logging.getLogger(__name__)

MOST_WORDS = 1000
"""Characters of an event in a status message."""


class Upkeep:
    """Merges beside the questions. Only its thread touches the merger; done answers replace those before."""

    def __init__(
        self,
        share: float,
        by_itself: bool = True,
        index: PlaceIndex | None = None,
        merge: MergeSettings | None = None,
    ) -> None:
        """Begin with nothing.

        Args:
            share: at most this share of the time is spent making the merged map anew.
            by_itself: merge whenever there is something new; else only when somebody waits for it.
            index: is filled with the nodes that come; may have them already.
            merge: how maps are merged.
        """
        self._share = share
        self._by_itself = by_itself
        self._merger = Merger(index, MergerSettings(merging=merge or MergeSettings()))
        self._changes: queue.SimpleQueue[Change | list[Change] | Rulings | threading.Event | None] = (
            queue.SimpleQueue()
        )
        self._answers = Answers.of(self._merger, MergedMap.empty())
        self._dirty = False
        self._event = ""
        self._counting = threading.Lock()
        self._came = self._applied = self._done = 0
        self._thread = threading.Thread(target=self._work, name="merge", daemon=True)

    @property
    def answers(self) -> Answers:
        """From the newest merged map."""
        return self._answers

    @property
    def event(self) -> str:
        """The newest of what has become one map, or is no longer one, with the reason."""
        return self._event[:MOST_WORDS]

    @property
    def settled(self) -> bool:
        """Whether everything that has come is merged, or could not be."""
        return self._done == self._came

    def start(self) -> None:
        """Begin to merge."""
        self._thread.start()

    def take(self, change: Change) -> None:
        """Take note of a change, in the order of its log. Returns at once."""
        self._put(change)

    def read(self, changes: Iterable[Change]) -> None:
        """Take note of many changes at once, map by map in the order of its log."""
        if many := list(changes):
            self._put(many)

    def rule(self, rulings: Rulings) -> None:
        """Heed these rulings of people from now on, and no others. Returns at once."""
        self._put(rulings)

    def settle(self, timeout: float) -> bool:
        """Wait until everything that came before this call is merged; False if the time is over first."""
        merged = threading.Event()
        self._changes.put(merged)
        return merged.wait(timeout)

    def close(self) -> None:
        """Stop after what has come."""
        self._changes.put(None)
        self._thread.join(30.0)

    def _put(self, news: Change | list[Change] | Rulings) -> None:
        with self._counting:
            self._came += 1
        self._changes.put(news)

    def _work(self) -> None:
        rest_until = 0.0
        while True:
            pause = max(rest_until - time.monotonic(), 0.0)
            try:
                waits = self._dirty and self._by_itself
                change = self._changes.get(timeout=pause + 0.02 if waits else None)
            except queue.Empty:
                began = time.monotonic()
                self._merge()
                spent = time.monotonic() - began
                rest_until = time.monotonic() + spent * (1.0 / self._share - 1.0)
                continue
            if change is None:
                return
            if isinstance(change, threading.Event):
                if self._dirty:
                    self._merge()
                change.set()
                continue
            if isinstance(change, Rulings):
                self._merger.rule(change)
            elif isinstance(change, list):
                self._read(change)
            else:
                self._apply(change)
            self._applied += 1
            self._dirty = True
            if time.monotonic() > rest_until + 2.0:
                rest_until = time.monotonic()

    def _read(self, changes: list[Change]) -> None:
        try:
            self._merger.read((change.map, change.body) for change in changes)
        except Exception:  # a log may be replayed: whatever is wrong with one change, the others are taken
            log.exception("the changes in the store are taken in one by one")
            for change in changes:
                self._apply(change)

    def _apply(self, change: Change) -> None:
        try:
            self._merger.on_change(change)
        except MapweaveError as error:
            log.warning("change %s of %s is not merged: %s", change.sequence, change.map, error)
        except Exception:  # a defect with one change must not end all merging
            log.exception("change %s of %s is not merged", change.sequence, change.map)

    def _merge(self) -> None:
        self._dirty = False
        before = self._answers.merged
        try:
            merged = self._merger.merged()
            self._answers = Answers.of(self._merger, merged)
        except Exception:  # questions are answered from the map before; the next change is the next chance
            log.exception("the merged map could not be made anew")
            self._event = "the merged map could not be made anew: see the server's log"
            return
        finally:
            self._done = self._applied
        for words in joinings(before, merged):
            log.info("%s", words)
            self._event = words
        for words in partings(before, merged):
            log.warning("%s", words)
            self._event = words
