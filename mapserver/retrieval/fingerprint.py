"""Fingerprint of a node's descriptors, independent of their order.

A node's fingerprint is the sum of one number a landmark, so it can be taken from a node and as well from
landmarks that lie scattered in an index. It guards against mistakes, not against malice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Prints = NDArray[np.uint64]

FACTORS = np.array(
    [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93], np.uint64
)
"""Odd random numbers; one for each eight bytes of a descriptor."""
LAST = np.uint64(0xFF51AFD7ED558CCD)
"""Of the mixing at the end, as in MurmurHash3 (Appleby)."""


def landmark_prints(codes: NDArray[np.uint8], numbers: NDArray[np.int64]) -> Prints:
    """(N,) the numbers of landmarks, modulo 2^64.

    Args:
        codes: (N, 32).
        numbers: (N,) which landmark of its node each is.
    """
    words = np.ascontiguousarray(codes).view("<u8")
    out: Prints = (words * FACTORS).sum(axis=1, dtype=np.uint64)
    out ^= out >> np.uint64(33)
    out *= LAST
    out ^= out >> np.uint64(29)
    out *= 2 * numbers.astype(np.uint64) + np.uint64(1)
    return out


def fingerprint(codes: NDArray[np.uint8]) -> int:
    """Of a node's (N, 32) codes."""
    return int(landmark_prints(codes, np.arange(len(codes))).sum(dtype=np.uint64))
