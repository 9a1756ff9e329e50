"""Descriptors of messages and maps of the first version, 16 bytes each, as codes of today.

There each of the 32 coordinates was rounded to one of 16 levels of its own (Lloyd 1982); two coordinates
share a byte, the even one in the low half.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.landmark_tables import landmark_tables

CODE_BYTES_V1 = 16
FILE_V1 = "descriptor_v1.npz"


@cache
def _tables_v1() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Mean (128,), basis (128, 32) and levels (32, 16) of the first version."""
    with resources.files("hybridmap").joinpath(FILE_V1).open("rb") as file, np.load(file) as stored:
        mean, basis, levels = (stored[name].astype(np.float32) for name in ("mean", "basis", "levels"))
        return mean, basis, levels


def restore_v1(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(N, 16) uint8 -> (N, 32) float32 coordinates in the basis of the first version."""
    levels = _tables_v1()[2]
    out = np.empty((len(codes), 2 * CODE_BYTES_V1), np.float32)
    even, odd = np.arange(0, 2 * CODE_BYTES_V1, 2), np.arange(1, 2 * CODE_BYTES_V1, 2)
    out[:, 0::2] = levels[even, codes & 15]
    out[:, 1::2] = levels[odd, codes >> 4]
    return out


def renew(codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(N, 16) uint8 of the first version -> (N, 32) uint8 codes of today, comparable with any other."""
    mean, basis, _ = _tables_v1()
    today = landmark_tables()
    roots = restore_v1(codes) @ basis.T + mean
    return quantise((roots - today.mean) @ today.basis)
