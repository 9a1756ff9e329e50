"""The fixed tables of compact landmarks: how SIFT is projected and rounded, and how often which step occurs.

They are part of the wire format: every robot and server of a fleet must hold the same ones. They are made by
`python -m benchmarks.train_descriptor --write` and carry a version, which every message contains.
"""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.node import CODE_BYTES

SIFT_DIMENSIONS = 128
"""Lowe 2004: 4 x 4 histograms of 8 directions."""
DIMENSIONS = CODE_BYTES
"""Coordinates of a compact descriptor."""

SYMBOLS = 64
"""Different values that a column of a landmark may have."""

TOTAL_BITS = 12
"""Frequencies of a column's symbols sum to 2^TOTAL_BITS."""

VERSION = 1
FILE = "landmarks.npz"


@dataclass(frozen=True, eq=False)
class LandmarkTables:
    """Quantization of SIFT descriptors and depths to small integers, and the bits that those cost.

    Attributes:
        mean: (128,) float32, mean RootSIFT descriptor.
        basis: (128, 32) float32, the axes on which descriptors are projected.
        step: of the grid on which each coordinate is rounded.
        codes: (32, 64) int64, frequencies of the symbols of each coordinate.
        shares: (64,) int64, likewise of a depth's uncertainty, see mapweave.hybridmap.quantization.
        cells: (64,) int64, likewise of a depth.
    """

    mean: NDArray[np.float32]
    basis: NDArray[np.float32]
    step: float
    codes: NDArray[np.int64]
    shares: NDArray[np.int64]
    cells: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Refuse shapes and sums that are not those of tables (InvalidFile)."""
        shapes = tuple(a.shape for a in (self.mean, self.basis, self.codes, self.shares, self.cells))
        wanted = (
            (SIFT_DIMENSIONS,), (SIFT_DIMENSIONS, DIMENSIONS), (DIMENSIONS, SYMBOLS), (SYMBOLS,), (SYMBOLS,),
        )  # fmt: skip
        if shapes != wanted or not self.step > 0:
            raise InvalidFile(f"landmark tables: shapes {shapes} are not those of tables")
        for frequencies in (self.codes, self.shares, self.cells):
            if (frequencies < 0).any() or (frequencies.sum(axis=-1) != 1 << TOTAL_BITS).any():
                raise InvalidFile(f"landmark tables: frequencies must sum to {1 << TOTAL_BITS}")
        if (self.codes == 0).any():
            raise InvalidFile("landmark tables: every value of a descriptor must be possible")


@cache
def landmark_tables() -> LandmarkTables:
    """The fleet's tables.

    Raises:
        InvalidFile: they are damaged, or of another version.
    """
    with resources.files("mapweave.hybridmap").joinpath(FILE).open("rb") as file, np.load(file) as stored:
        if int(stored["version"]) != VERSION:
            raise InvalidFile(f"landmark tables: version {int(stored['version'])}, expected {VERSION}")

        def whole(name: str) -> NDArray[np.int64]:
            numbers: NDArray[Any] = stored[name]
            return numbers.astype(np.int64)

        return LandmarkTables(
            stored["mean"].astype(np.float32), stored["basis"].astype(np.float32), float(stored["step"]),
            whole("codes"), whole("shares"), whole("cells"),
        )  # fmt: skip
