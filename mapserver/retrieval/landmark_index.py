"""The nearest of all landmarks of the fleet: one by one while they are few, by cells when many.

What is found depends on the wanted landmarks alone: not on the order in which they came, nor on those that
are hidden. Their number decides how large the cells are that are searched, and all landmarks are kept in such
cells. Where most are hidden, they are kept in cells of two sizes: a question that hides nothing searches
smaller ones.
"""

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mapweave.mapserver.retrieval.coarse_quantizer import Codes, Ids, Vectors, coarse_quantizers
from mapweave.mapserver.retrieval.flat_landmarks import FlatLandmarks
from mapweave.mapserver.retrieval.inverted_file import CellContents, InvertedFile
from mapweave.mapserver.retrieval.shared_lock import SharedLock
from mapweave.mapserver.retrieval.wanted_landmarks import Hidden

MOST_WITHIN = 256
"""Largest number of similar landmarks of one: where thousands are similar, their pairs grow by the square.
While `within` works there are about 200 nodes, and each shows a thing once."""
AT_ONCE = 1 << 19
"""Landmarks that are copied at once when other cells are filled."""
FLAT = 0
"""The size of no cells: every landmark is compared."""
UNUSED = 4
"""Cells of another size are dropped when they were not searched while a quarter of the landmarks changed."""
LEAST_PROBES = 2
"""Cells that are searched at least."""

Landmarks = FlatLandmarks | InvertedFile


@dataclass(frozen=True)
class LandmarkIndexSettings:
    """How landmarks are found.

    Attributes:
        exact: up to as many every one is compared; beyond, those of some cells, and `within` does not work.
        fill: landmarks in a cell on average beyond which smaller cells are searched.
        probes: cells that are searched for a feature of a view; fewer where the smallest are fuller.
    """

    exact: int = 30_000
    fill: int = 400
    probes: int = 10


class LandmarkIndex:
    """Codes with ids. Ids rise: what comes later has greater ones.

    Attributes:
        lock: of all that is in it.
    """

    def __init__(self, settings: LandmarkIndexSettings | None = None) -> None:
        self.lock = SharedLock()
        self._settings = settings or LandmarkIndexSettings()
        self._kept: dict[int, Landmarks] = {FLAT: FlatLandmarks()}
        self._searched: dict[int, int] = {}
        """Of each size what `_changed` was when it was last searched."""
        self._changed = 0
        self._making = threading.Lock()

    def __len__(self) -> int:
        return len(self._any)

    def cells(self, wanted: int) -> int:
        """How many cells there are where so many landmarks are wanted; 0 where every one is compared."""
        size = self._size(wanted)
        return 0 if size == FLAT else len(coarse_quantizers()[size - 1])

    def add(self, codes: Codes, ids: Ids) -> None:
        """Take in (N, 32) codes with (N,) ids."""
        if not len(codes):
            return
        with self.lock.writing():
            for landmarks in self._kept.values():
                landmarks.add(codes, ids)
            self._changed += len(ids)
            size = self._size(len(self))
            # Smaller cells as soon as they are needed: many landmarks without cells take much memory.
            if size > max(self._kept):
                self._kept[size] = self._made(size)
            self._drop_unused(size)

    def remove(self, first: int, last: int, codes: Codes | None = None) -> None:
        """Forget the ids from first to last, that one left out; quickly, if all their codes are known."""
        with self.lock.writing():
            before = len(self)
            for landmarks in self._kept.values():
                landmarks.remove(first, last, codes)
            self._changed += before - len(self)

    def nearest(
        self, codes: Codes, k: int, hidden: Hidden | None = None, wanted: int | None = None
    ) -> tuple[Vectors, Ids]:
        """(N, k) squared distances and ids of the nearest landmarks, nearest first; id -1 is none.

        Args:
            codes: (N, 32).
            k: how many of each.
            hidden: which ids are as if they were not there.
            wanted: how many are not hidden; all, if it is not given.
        """
        with self.lock.reading():
            wanted = len(self) if wanted is None else wanted
            landmarks = self._of_size(self._size(wanted))
            if isinstance(landmarks, FlatLandmarks):
                return landmarks.nearest(codes, k, hidden)
            return landmarks.nearest(codes, k, self._probes(wanted, landmarks), hidden)

    def within(self, codes: Codes, reach: float) -> tuple[Ids, Vectors, Ids] | None:
        """(M,) row of the code, squared distance and id of the `MOST_WITHIN` nearest landmarks within reach.

        Returns:
            None if there are too many landmarks for that.
        """
        with self.lock.reading():
            if len(self) > self._settings.exact:
                return None
            landmarks = self._of_size(FLAT)
            assert isinstance(landmarks, FlatLandmarks)
            return landmarks.within(codes, reach, MOST_WITHIN)

    def blocks(self) -> Iterator[CellContents]:
        """Landmarks by cells, as they are when their turn comes; without cells, all."""
        with self.lock.reading():
            blocks = self._any.blocks(AT_ONCE)
        while True:
            with self.lock.reading():
                block = next(blocks, None)
            if block is None:
                return
            yield block

    @property
    def _any(self) -> Landmarks:
        """All landmarks, in cells of whichever size."""
        # A copy: another thread may add cells of another size meanwhile.
        return next(iter(tuple(self._kept.values())))

    def _size(self, wanted: int) -> int:
        """How small the cells are: FLAT, or 1 for the largest ones, 2 for the next, and so on."""
        if wanted <= self._settings.exact:
            return FLAT
        sizes = coarse_quantizers()
        full = (size for size, q in enumerate(sizes, 1) if wanted <= self._settings.fill * len(q))
        return next(full, len(sizes))

    def _probes(self, wanted: int, landmarks: InvertedFile) -> int:
        """How many cells are searched."""
        s = self._settings
        share = s.fill * len(landmarks.quantizer) / max(wanted, 1)
        return s.probes if share >= 1 else min(s.probes, max(round(s.probes * share), LEAST_PROBES))

    def _of_size(self, size: int) -> Landmarks:
        """All landmarks in cells of a size; they are filled when these are first searched.

        Others who search go on meanwhile; who adds or removes waits for them.
        """
        landmarks = self._kept.get(size)
        if landmarks is None:
            with self._making:
                landmarks = self._kept.get(size)
                if landmarks is None:
                    landmarks = self._kept[size] = self._made(size)
        self._searched[size] = self._changed
        return landmarks

    def _made(self, size: int) -> Landmarks:
        landmarks = FlatLandmarks() if size == FLAT else InvertedFile(coarse_quantizers()[size - 1])
        codes, ids = map(np.concatenate, zip(*self._any.blocks(AT_ONCE), strict=True))
        # In the order in which they came: of equally near ones the first is found.
        order = np.argsort(ids, kind="stable")
        for start in range(0, len(ids), AT_ONCE):
            part = order[start : start + AT_ONCE]
            landmarks.add(codes[part], ids[part])
        return landmarks

    def _drop_unused(self, needed: int) -> None:
        """Drop what was not searched recently, but not what has the size needed for all landmarks."""
        recent = self._changed - len(self) // UNUSED
        for size in [size for size in self._kept if size != needed and needed in self._kept]:
            if self._searched.get(size, -1) < recent:
                del self._kept[size]
                self._searched.pop(size, None)
