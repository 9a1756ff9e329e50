"""Cells of the space of compact descriptors, in four sizes; they come with the package and never change.

A landmark belongs to the nearest centre of the nearest family. A question asks for the several nearest
centres of the nearest few families. No robot's data moves them: they are made of the project's own pictures,
by `python -m benchmarks.train_cells --write`.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.landmark_tables import DIMENSIONS, SYMBOLS, VERSION

FILE = "cells.npz"
FAMILIES = (16, 32, 64, 128)
"""Of each size of cells. A family has as many cells as there are families."""
SEARCHED = 12
"""Families among whose centres a question finds the nearest, at least."""
BLOCK = 1 << 17
"""Codes that are widened to floats at once."""

Codes = NDArray[np.uint8]
Ids = NDArray[np.int64]
Vectors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CoarseQuantizer:
    """Centres in families.

    Attributes:
        heads: (F, 32) uint8, the centre of each family, in steps of the descriptors as codes are.
        centres: (F * F, 32) uint8, by families.
    """

    heads: Codes
    centres: Codes

    def __post_init__(self) -> None:
        """Refuse what are no families of codes (InvalidFile)."""
        families = len(self.heads)
        shapes = self.heads.shape, self.centres.shape
        if not families or shapes != ((families, DIMENSIONS), (families * families, DIMENSIONS)):
            raise InvalidFile(f"cells: {shapes} are no families of as many centres")
        if any(codes.dtype != np.uint8 or codes.max() >= SYMBOLS for codes in (self.heads, self.centres)):
            raise InvalidFile("cells: centres that are no codes")

    def __len__(self) -> int:
        return len(self.centres)

    def nearest(self, vectors: Vectors) -> Ids:
        """(N,) which cell each of (N, 32) vectors belongs to."""
        cells: Ids = self.searched.search(vectors, 1, params=probing(1))[1][:, 0]
        return cells

    def probing(self, count: int) -> Any:
        """Search so many cells, among families that have twice as many."""
        families = len(self.heads)
        of_these = min(max(SEARCHED, -(-2 * count // families)), families)
        return probing(min(count, len(self)), probing(of_these))

    @cached_property
    def searched(self) -> Any:
        """A FAISS index that finds the several nearest centres of SEARCHED families."""
        import faiss

        heads, families = faiss.IndexFlatL2(DIMENSIONS), len(self.heads)
        heads.add(self.heads.astype(np.float32))
        index = faiss.IndexIVFFlat(heads, DIMENSIONS, families)
        index.is_trained = True
        centres, numbers = self.centres.astype(np.float32), np.arange(len(self.centres))
        family = numbers // families
        index.add_core(
            len(numbers), faiss.swig_ptr(centres), faiss.swig_ptr(numbers), faiss.swig_ptr(family), None
        )
        index.nprobe = min(SEARCHED, families)
        return index


@cache
def coarse_quantizers() -> tuple[CoarseQuantizer, ...]:
    """Those of the package, of ever smaller cells.

    Raises:
        InvalidFile: they are damaged, or made of other codes than those of landmarks are.
    """
    path = resources.files("mapweave.mapserver.retrieval").joinpath(FILE)
    with path.open("rb") as file, np.load(file) as stored:
        if int(stored["version"]) != VERSION:
            raise InvalidFile(f"cells: of landmarks of version {int(stored['version'])}, not {VERSION}")
        return tuple(CoarseQuantizer(stored[f"heads{f}"], stored[f"centres{f}"]) for f in FAMILIES)


def probing(count: int, within: Any = None) -> Any:
    """Search so many lists of an inverted file; likewise where its own centres are searched."""
    import faiss

    parameters: Any = faiss.SearchParametersIVF
    return parameters(nprobe=count, quantizer_params=within)
