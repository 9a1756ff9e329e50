"""Landmarks of a small fleet, of which every one is compared."""

from collections.abc import Iterator

import numpy as np

from mapweave.hybridmap.landmark_tables import DIMENSIONS
from mapweave.mapserver.retrieval.coarse_quantizer import Codes, Ids, Vectors
from mapweave.mapserver.retrieval.inverted_file import CellContents
from mapweave.mapserver.retrieval.similar_landmarks import comparable, nearest, similar
from mapweave.mapserver.retrieval.wanted_landmarks import Hidden


class FlatLandmarks:
    """Codes with ids, in the order in which they came."""

    def __init__(self) -> None:
        self._codes = np.zeros((0, DIMENSIONS), np.uint8)
        self._ids = np.zeros(0, np.int64)
        self._rows = comparable(self._codes)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def codes(self) -> Codes:
        """(N, 32)."""
        return self._codes[: self._count]

    @property
    def ids(self) -> Ids:
        """(N,)."""
        return self._ids[: self._count]

    def add(self, codes: Codes, ids: Ids) -> None:
        """Take in (N, 32) codes with (N,) ids."""
        start, self._count = self._count, self._count + len(ids)
        if self._count > len(self._ids):
            # Room for as many again: what is there is copied a few times in all.
            room = 2 * self._count
            self._codes, self._rows, self._ids = (
                np.resize(kept, (room, *kept.shape[1:])) for kept in (self._codes, self._rows, self._ids)
            )
        part = slice(start, self._count)
        self._codes[part], self._ids[part], self._rows[part] = codes, ids, comparable(codes)

    def remove(self, first: int, last: int, codes: Codes | None = None) -> None:
        """Forget the ids from first to last, that one left out; their codes are not needed."""
        del codes
        kept = np.flatnonzero((self.ids < first) | (self.ids >= last))
        for values in (self._codes, self._ids, self._rows):
            values[: len(kept)] = values[kept]
        self._count = len(kept)

    def nearest(self, codes: Codes, k: int, hidden: Hidden | None = None) -> tuple[Vectors, Ids]:
        """The k nearest landmarks, see `InvertedFile.nearest`."""
        unwanted = None if hidden is None else hidden(self.ids)
        squared, places = nearest(self._rows[: self._count], codes, k, unwanted)
        # -1 is none.
        return squared, np.append(self.ids, -1)[places]

    def within(self, codes: Codes, reach: float, most: int) -> tuple[Ids, Vectors, Ids]:
        """(M,) row of the code, squared distance and id of the `most` nearest landmarks within reach."""
        places, rows, squared = similar(self._rows[: self._count], codes, reach)
        order = np.lexsort((squared, rows))
        rows, squared, ids = rows[order], squared[order], self.ids[places[order]]
        begins = np.searchsorted(rows, np.arange(len(codes)))
        nearest = np.arange(len(rows)) - begins[rows] < most
        return rows[nearest], squared[nearest], ids[nearest]

    def blocks(self, size: int) -> Iterator[CellContents]:
        """All landmarks at once in the order of their ids: they are few."""
        del size
        order = np.argsort(self.ids, kind="stable")
        yield CellContents(self.codes[order], self.ids[order])
