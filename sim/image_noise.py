"""Noise fields: the grain of plaster and wood, and clouds."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]


def noise(rng: np.random.Generator, width_px: int, height_px: int, size_px: float) -> Field:
    """Smooth noise with structures of about one size, (height, width), deviation about 1."""
    shape = (max(2, int(height_px / size_px)) + 2, max(2, int(width_px / size_px)) + 2)
    coarse = rng.standard_normal(shape, dtype=np.float32)
    return np.asarray(
        cv2.resize(coarse, (width_px, height_px), interpolation=cv2.INTER_CUBIC), dtype=np.float32
    )


def clouds(rng: np.random.Generator, width_px: int, height_px: int, steepness: float) -> Field:
    """Noise at all scales from the whole picture down to 2 px, deviation about 1.

    Args:
        rng: random numbers.
        width_px: across.
        height_px: down.
        steepness: 1 has equal power at each scale; larger is softer.
    """
    total: NDArray[Any] = np.zeros((height_px, width_px), np.float32)
    size = float(max(width_px, height_px)) / 2
    weight, power = 1.0, 0.0
    while size >= 2.0:
        total = total + weight * noise(rng, width_px, height_px, size)
        power += weight**2
        weight /= 2 ** (steepness - 1)
        size /= 2
    return np.asarray(total / np.sqrt(max(power, 1e-9)), dtype=np.float32)
