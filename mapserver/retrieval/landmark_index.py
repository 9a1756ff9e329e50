"""The nearest of all landmarks of the fleet: one by one while they are few, by cells that grow when many.

Cells are trained again as landmarks come; until new ones are ready the old ones are used, with all landmarks.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapweave.mapserver.retrieval.coarse_quantizer import SAMPLE, CoarseQuantizer, Codes, Ids, Vectors
from mapweave.mapserver.retrieval.flat_landmarks import FlatLandmarks
from mapweave.mapserver.retrieval.inverted_file import CellContents, InvertedFile
from mapweave.mapserver.retrieval.shared_lock import SharedLock
from mapweave.mapserver.retrieval.wanted_landmarks import Hidden

log = logging.getLogger(__name__)

MOST_WITHIN = 256
"""Largest number of similar landmarks of one: where thousands are similar, their pairs grow by the square.
While `within` works there are about 200 nodes, and each shows a thing once."""
AT_ONCE = 1 << 19
"""Landmarks that are copied at once when new cells are filled from old ones."""


@dataclass(frozen=True)
class LandmarkIndexSettings:
    """How landmarks are found.

    Attributes:
        exact: up to as many every one is compared; beyond, those of some cells, and `within` does not work.
        growth: cells are trained again when there are so many times as many landmarks.
        probes: cells that are searched for a feature of a view.
        patience: landmarks beyond which cells are trained in the background of questions, not between them.
    """

    exact: int = 30_000
    growth: float = 4.0
    probes: int = 8
    patience: int = 100_000


class AddedRows(NamedTuple):
    """Landmarks that came while cells were learned."""

    codes: Codes
    ids: Ids


class RemovedRows(NamedTuple):
    """Ids that went while cells were learned, the last one left out, and their codes if they are known."""

    first: int
    last: int
    codes: Codes | None


FILL = 100
"""Landmarks in a cell when it is learned, on average."""
MOST_CELLS = 1 << 18
"""With as many, cells are not learned again: filling new ones takes the memory twice. These are learned at
40 million landmarks, where twice is still less than a million nodes take once."""


class LandmarkIndex:
    """Codes with ids. Ids rise: what comes later has greater ones.

    Attributes:
        lock: of all that is in it.
    """

    def __init__(self, settings: LandmarkIndexSettings | None = None) -> None:
        """Start empty."""
        self.lock = SharedLock()
        self._settings = settings or LandmarkIndexSettings()
        self._landmarks: FlatLandmarks | InvertedFile = FlatLandmarks()
        self._learned = 0
        self._learner: threading.Thread | None = None
        self._missed: list[AddedRows | RemovedRows] = []
        self._end = 0

    def __len__(self) -> int:
        """How many landmarks."""
        return len(self._landmarks)

    @property
    def means(self) -> CoarseQuantizer | None:
        """What the cells are about; None as long as there are none."""
        return None if isinstance(self._landmarks, FlatLandmarks) else self._landmarks.means

    def add(self, codes: Codes, ids: Ids) -> None:
        """Take in (N, 32) codes with (N,) ids."""
        if not len(codes):
            return
        with self.lock.writing():
            self._end = int(ids[-1]) + 1
            if self._learner is not None:
                self._missed.append(AddedRows(codes, ids))
            self._landmarks.add(codes, ids)
            self._grow()

    def remove(self, first: int, last: int, codes: Codes | None = None) -> None:
        """Forget the ids from first to last, that one left out; quickly, if all their codes are known."""
        with self.lock.writing():
            if self._learner is not None:
                self._missed.append(RemovedRows(first, last, codes))
            self._landmarks.remove(first, last, codes)

    def nearest(self, codes: Codes, k: int, hidden: Hidden | None = None) -> tuple[Vectors, Ids]:
        """(N, k) squared distances and ids of the nearest landmarks, nearest first; id -1 is none.

        What is hidden is as if it were not there.
        """
        with self.lock.reading():
            if isinstance(self._landmarks, FlatLandmarks):
                return self._landmarks.nearest(codes, k, hidden)
            return self._landmarks.nearest(codes, k, self._settings.probes, hidden)

    def within(self, codes: Codes, reach: float) -> tuple[Ids, Vectors, Ids] | None:
        """(M,) row of the code, squared distance and id of the `MOST_WITHIN` nearest landmarks within reach.

        Returns:
            None if there are too many landmarks for that.
        """
        with self.lock.reading():
            if isinstance(self._landmarks, FlatLandmarks):
                return self._landmarks.within(codes, reach, MOST_WITHIN)
            return None

    def keep_up(self) -> None:
        """Wait for the training of cells if too many landmarks have come since: they are kept twice."""
        with self.lock.reading():
            missed = sum(len(change.ids) for change in self._missed if isinstance(change, AddedRows))
        if missed > self._settings.patience:
            self.settle()

    def settle(self) -> None:
        """Wait until cells that are being learned are in use."""
        learner = self._learner
        if learner is not None:
            learner.join()

    def blocks(self) -> Iterator[CellContents]:
        """Landmarks by cells, as they are when their turn comes; without cells, all."""
        with self.lock.reading():
            return self._in_turn(self._landmarks.blocks(AT_ONCE))

    def _in_turn(self, blocks: Iterator[CellContents]) -> Iterator[CellContents]:
        while True:
            with self.lock.reading():
                block = next(blocks, None)
            if block is None:
                return
            yield block

    def _grow(self) -> None:
        """Learn cells if there are many more landmarks than when it was last done."""
        s, n = self._settings, len(self)
        few = self.means is None or len(self.means) < MOST_CELLS
        if n <= s.exact or n < s.growth * self._learned or self._learner is not None or not few:
            return
        self._learned, self._missed = n, []
        if n <= s.patience:
            self._landmarks = self._new(n, self._end)
            return
        self._learner = threading.Thread(target=self._learn, args=(n, self._end), name="cells", daemon=True)
        self._learner.start()

    def _learn(self, n: int, end: int) -> None:
        """In a thread of its own: train new cells, add landmarks that came since, and hand over."""
        try:
            cells = self._new(n, end)
            while True:
                with self.lock.writing():
                    missed, self._missed = self._missed, []
                    if not missed:
                        self._landmarks, self._learner = cells, None
                        return
                _catch_up(cells, missed)
        except Exception:  # the old cells go on serving, more slowly
            log.exception("the place index could not be made faster")
            with self.lock.writing():
                self._learner, self._missed = None, []

    def _new(self, n: int, end: int) -> InvertedFile:
        """Cells for the landmarks below an id, which are n; what has come since is among what was missed."""
        count = min(max(2 ** round(math.log2(n / FILL)), 16), MOST_CELLS)
        step = max(n // (SAMPLE * count), 1)
        # A part of a block would keep the whole of it.
        sample = np.concatenate([block.codes[::step].copy() for block in self.blocks()])
        cells = InvertedFile(CoarseQuantizer.learn(sample, count))
        for block in self.blocks():
            old = block.ids < end
            cells.add(block.codes[old], block.ids[old])
        return cells


def _catch_up(cells: InvertedFile, missed: list[AddedRows | RemovedRows]) -> None:
    for change in missed:
        if isinstance(change, AddedRows):
            cells.add(change.codes, change.ids)
        else:
            cells.remove(change.first, change.last, change.codes)
