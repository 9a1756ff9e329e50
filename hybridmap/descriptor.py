"""Compact SIFT: 512 bytes become 16, and most geometric matches survive.

A descriptor is made RootSIFT (Arandjelovic and Zisserman, CVPR 2012: divide by the L1 norm, take square
roots, so that Euclidean distance compares histograms by the Hellinger kernel), centred, projected on a fixed
32-dimensional PCA basis, and each coordinate is rounded to one of 16 levels that Lloyd's algorithm chose for
that coordinate. Two coordinates share a byte, the even one in the low half.

The table is part of the wire format: every robot and server of a fleet must hold the same one. It is made by
`python -m benchmarks.train_descriptor --write` and carries a version.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import InvalidFile, InvalidValue
from hybridmap.node import CODE_BYTES

SIFT_DIMENSIONS = 128
DIMENSIONS = 2 * CODE_BYTES
"""Length of a decoded descriptor."""

LEVELS = 16
TABLE_VERSION = 1
TABLE_NAME = "descriptor_v1.npz"


@dataclass(frozen=True, eq=False)
class Table:
    """What turns SIFT into codes and back.

    Attributes:
        mean: (128,) float32, mean RootSIFT descriptor.
        basis: (128, 32) float32, orthonormal columns.
        levels: (32, 16) float32, ascending reconstruction levels of each coordinate.
    """

    mean: NDArray[np.float32]
    basis: NDArray[np.float32]
    levels: NDArray[np.float32]

    def __post_init__(self) -> None:
        """Check shapes and order.

        Raises:
            InvalidFile: this is no table.
        """
        shapes = (self.mean.shape, self.basis.shape, self.levels.shape)
        if shapes != ((SIFT_DIMENSIONS,), (SIFT_DIMENSIONS, DIMENSIONS), (DIMENSIONS, LEVELS)):
            raise InvalidFile(f"descriptor table: shapes {shapes} are not those of a table")
        if not (np.diff(self.levels, axis=1) > 0).all():
            raise InvalidFile("descriptor table: levels must ascend")

    def project(self, sift: NDArray[Any]) -> NDArray[np.float32]:
        """(N, 128) SIFT -> (N, 32) float32 coordinates before rounding.

        Raises:
            InvalidValue: the input is not (N, 128) finite.
        """
        centred: NDArray[np.float32] = root_sift(sift) - self.mean
        out: NDArray[np.float32] = np.matmul(centred, self.basis)
        return out

    def quantise(self, projected: NDArray[np.float32]) -> NDArray[np.uint8]:
        """(N, 32) coordinates -> (N, 16) codes: each coordinate to its nearest level."""
        thresholds: NDArray[Any] = (self.levels[:, 1:] + self.levels[:, :-1]) / 2
        symbols = np.empty(projected.shape, np.uint8)
        for k in range(DIMENSIONS):
            symbols[:, k] = np.searchsorted(thresholds[k], projected[:, k])
        return symbols[:, 0::2] | (symbols[:, 1::2] << np.uint8(4))

    def restore(self, codes: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(N, 16) codes -> (N, 32) float32 coordinates."""
        out = np.empty((len(codes), DIMENSIONS), np.float32)
        even, odd = np.arange(0, DIMENSIONS, 2), np.arange(1, DIMENSIONS, 2)
        out[:, 0::2] = self.levels[even, codes & 15]
        out[:, 1::2] = self.levels[odd, codes >> 4]
        return out


def root_sift(sift: NDArray[Any]) -> NDArray[np.float32]:
    """(N, 128) SIFT -> (N, 128) float32 of unit length; an empty histogram stays zero.

    Raises:
        InvalidValue: the input is not (N, 128) finite.
    """
    sift = np.asarray(sift, dtype=np.float32)
    if sift.ndim != 2 or sift.shape[1] != SIFT_DIMENSIONS or not np.isfinite(sift).all():
        raise InvalidValue(f"SIFT descriptors must be (N, 128) finite, not {sift.shape}")
    sift = np.maximum(sift, np.float32(0))
    total = np.maximum(sift.sum(axis=1, keepdims=True), 1e-12)
    out: NDArray[np.float32] = np.sqrt(sift / total).astype(np.float32, copy=False)
    return out


@cache
def table() -> Table:
    """The fleet's table.

    Raises:
        InvalidFile: it is damaged, or of another version.
    """
    with resources.files("hybridmap").joinpath(TABLE_NAME).open("rb") as file, np.load(file) as stored:
        if int(stored["version"]) != TABLE_VERSION:
            raise InvalidFile(f"descriptor table: version {int(stored['version'])}, expected {TABLE_VERSION}")
        return Table(*(stored[name].astype(np.float32) for name in ("mean", "basis", "levels")))


def encode(sift: NDArray[Any]) -> NDArray[np.uint8]:
    """Compress descriptors.

    Args:
        sift: (N, 128) SIFT descriptors of any scale, as OpenCV gives them.

    Returns:
        (N, 16) uint8 codes.

    Raises:
        InvalidValue: the input is not (N, 128) finite.
    """
    the_table = table()
    return the_table.quantise(the_table.project(sift))


def decode(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Restore descriptors for comparison by Euclidean distance.

    Args:
        codes: (N, 16) uint8.

    Returns:
        (N, 32) float32, centred RootSIFT in the PCA basis.

    Raises:
        InvalidValue: the input is not (N, 16) bytes.
    """
    codes = np.asarray(codes)
    if codes.ndim != 2 or codes.shape[1] != CODE_BYTES or codes.dtype != np.uint8:
        raise InvalidValue(f"codes must be (N, {CODE_BYTES}) uint8, not {codes.shape} {codes.dtype}")
    return table().restore(codes)
