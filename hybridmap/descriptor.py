"""Compact SIFT: 512 bytes become 32 small numbers, about 13.3 bytes on the wire, and most matches survive.

A descriptor is made RootSIFT (Arandjelovic and Zisserman, CVPR 2012: divide by the L1 norm, take square
roots, so that Euclidean distance compares histograms by the Hellinger kernel), centred, projected on 32 fixed
axes that tell features apart (benchmarks.train_descriptor), and each coordinate is rounded to a whole number
of steps, the same step for all. With a coder that spends bits by frequency (mapweave.wire.landmark_codec)
that is within a quarter of a bit a coordinate of the best that any rounding can do (Gish and Pierce 1968).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.landmark_tables import (
    DIMENSIONS,
    SIFT_DIMENSIONS,
    SYMBOLS,
    LandmarkTables,
    landmark_tables,
)
from mapweave.hybridmap.node import CODE_BYTES

ZERO = SYMBOLS // 2
"""The symbol of a coordinate of zero steps."""


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


def project(sift: NDArray[Any], tables: LandmarkTables | None = None) -> NDArray[np.float32]:
    """(N, 128) SIFT -> (N, 32) float32 coordinates before rounding.

    Raises:
        InvalidValue: the input is not (N, 128) finite.
    """
    t = tables or landmark_tables()
    out: NDArray[np.float32] = np.matmul(root_sift(sift) - t.mean, t.basis)
    return out


def quantise(projected: NDArray[Any], tables: LandmarkTables | None = None) -> NDArray[np.uint8]:
    """(N, 32) coordinates -> (N, 32) codes: whole steps from ZERO, cut off at both ends."""
    t = tables or landmark_tables()
    steps = np.rint(np.asarray(projected) / np.float32(t.step)) + ZERO
    codes: NDArray[np.uint8] = np.clip(steps, 0, SYMBOLS - 1).astype(np.uint8)
    return codes


def encode(sift: NDArray[Any]) -> NDArray[np.uint8]:
    """Compress descriptors.

    Args:
        sift: (N, 128) SIFT descriptors of any scale, as OpenCV gives them.

    Returns:
        (N, 32) uint8 codes below 64.

    Raises:
        InvalidValue: the input is not (N, 128) finite.
    """
    return quantise(project(sift))


def decode(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Restore descriptors for comparison by Euclidean distance.

    Args:
        codes: (N, 32) uint8.

    Returns:
        (N, 32) float32, centred RootSIFT on those axes.

    Raises:
        InvalidValue: the input is not (N, 32) bytes.
    """
    codes = np.asarray(codes)
    if codes.ndim != 2 or codes.shape[1] != CODE_BYTES or codes.dtype != np.uint8:
        raise InvalidValue(f"codes must be (N, {CODE_BYTES}) uint8, not {codes.shape} {codes.dtype}")
    return (codes.astype(np.float32) - np.float32(ZERO)) * np.float32(landmark_tables().step)


def rounding_noise() -> float:
    """What rounding adds to the squared distance of two decoded descriptors on average.

    Each of the 32 coordinates is off by a uniform error of variance step^2 / 12, on both sides.
    """
    return 2 * DIMENSIONS * landmark_tables().step ** 2 / 12
