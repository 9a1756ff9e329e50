"""Compact descriptors of a large fleet in cells of the descriptors' space, of which a few are searched.

FAISS's inverted file, a byte a coordinate: whole steps are kept as they are in the nodes, so distances are
exact, and only cells that are not searched can hide something.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from mapweave.hybridmap.landmark_tables import DIMENSIONS, landmark_tables
from mapweave.mapserver.retrieval.coarse_quantizer import BLOCK, CoarseQuantizer, Codes, Ids, Vectors
from mapweave.mapserver.retrieval.wanted_landmarks import Hidden, nearest_wanted

STEP2 = np.float32(landmark_tables().step ** 2)
"""What a squared distance of codes is worth."""
MOST_FOUND = 1 << 18
"""Landmarks that one search finds at most, hidden ones among them."""


class CellContents(NamedTuple):
    """Landmarks as they lie in the cells.

    Attributes:
        codes: (N, 32).
        ids: (N,).
    """

    codes: Codes
    ids: Ids


class InvertedFile:
    """Codes with ids, in cells that do not change.

    Attributes:
        quantizer: the cells.
    """

    def __init__(self, quantizer: CoarseQuantizer) -> None:
        import faiss

        self.quantizer = quantizer
        self._index: Any = faiss.IndexIVFScalarQuantizer(
            quantizer.searched, DIMENSIONS, len(quantizer), faiss.ScalarQuantizer.QT_8bit_direct,
            faiss.METRIC_L2, False,
        )  # fmt: skip
        self._index.train(np.zeros((1, DIMENSIONS), np.float32))

    def __len__(self) -> int:
        return int(self._index.ntotal)

    def add(self, codes: Codes, ids: Ids) -> None:
        """Sort (N, 32) codes in."""
        for start in range(0, len(codes), BLOCK):
            part = slice(start, start + BLOCK)
            vectors = codes[part].astype(np.float32)
            self._put(vectors, ids[part], self.quantizer.nearest(vectors))

    def remove(self, first: int, last: int, codes: Codes | None = None) -> None:
        """Forget the ids from first to last, that one left out.

        Args:
            first: id.
            last: id.
            codes: (N, 32) of all of them, in any order: gives their cells. Without it, or if it is wrong, the
                ids in all cells are searched.
        """
        import faiss

        left = None if codes is None else len(codes) - self._taken_out(first, last, codes)
        if left != 0:
            self._index.remove_ids(faiss.IDSelectorRange(first, last))

    def _taken_out(self, first: int, last: int, codes: Codes) -> int:
        """Forget those that lie where they should; how many they were."""
        import faiss

        lists: Any = self._index.invlists
        count = 0
        for cell in np.unique(self.quantizer.nearest(codes.astype(np.float32))).tolist():
            size = lists.list_size(cell)
            ids = faiss.rev_swig_ptr(lists.get_ids(cell), size) if size else np.zeros(0, np.int64)
            inside = np.flatnonzero((ids >= first) & (ids < last))
            # From the back: the last of the cell takes the place of each.
            for at in inside[::-1].tolist():
                size -= 1
                lists.update_entry(
                    cell, at, lists.get_single_id(cell, size), lists.get_single_code(cell, size)
                )
            if len(inside):
                lists.resize(cell, size)
                count += len(inside)
        self._index.ntotal -= count
        return count

    def nearest(self, codes: Codes, k: int, probes: int, hidden: Hidden | None = None) -> tuple[Vectors, Ids]:
        """The k nearest landmarks in the nearest cells.

        Args:
            codes: (N, 32).
            k: at most.
            probes: cells to search.
            hidden: which ids are not wanted.

        Returns:
            (N, k) squared distances of decoded descriptors, and ids; -1 where there are fewer.
        """
        vectors, searching = codes.astype(np.float32), self.quantizer.probing(probes)

        def search(features: Ids, count: int) -> tuple[Vectors, Ids]:
            squared, ids = self._index.search(vectors[features], count, params=searching)
            return squared * STEP2, ids

        if hidden is None:
            return search(np.arange(len(codes)), k)
        return nearest_wanted(search, len(codes), k, hidden, MOST_FOUND)

    def blocks(self, size: int) -> Iterator[CellContents]:
        """All landmarks, cell by cell, about `size` at once: a copy of all would take the memory twice."""
        import faiss

        lists: Any = self._index.invlists
        cell = 0
        while cell < self._index.nlist:
            codes, ids = [np.zeros((0, DIMENSIONS), np.uint8)], [np.zeros(0, np.int64)]
            some = 0
            while cell < self._index.nlist and some < size:
                n = lists.list_size(cell)
                if n:
                    codes.append(faiss.rev_swig_ptr(lists.get_codes(cell), n * DIMENSIONS).reshape(n, -1))
                    ids.append(faiss.rev_swig_ptr(lists.get_ids(cell), n))
                cell, some = cell + 1, some + n
            # What is concatenated is copied.
            yield CellContents(np.concatenate(codes), np.concatenate(ids))

    def _put(self, vectors: Vectors, ids: Ids, cells: Ids) -> None:
        import faiss

        ids, cells = np.ascontiguousarray(ids), np.ascontiguousarray(cells)
        self._index.add_core(
            len(vectors), faiss.swig_ptr(vectors), faiss.swig_ptr(ids), faiss.swig_ptr(cells), None
        )
