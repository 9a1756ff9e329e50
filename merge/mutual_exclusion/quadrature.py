"""Quadrature: fixed samples of a normal distribution in the plane."""

import math

import numpy as np

from mapweave.hybridmap.pose import Array


def _evenly_spread() -> Array:
    """(64, 2) equally likely points of a normal distribution in the plane: eight rings of eight."""
    radii = np.sqrt(-2.0 * np.log(1.0 - (np.arange(8) + 0.5) / 8))
    angles = 2 * math.pi * (np.arange(8)[None] + 0.5 * (np.arange(8)[:, None] % 2)) / 8
    points = np.stack([radii[:, None] * np.cos(angles), radii[:, None] * np.sin(angles)], axis=-1)
    flat = points.reshape(-1, 2)
    out: Array = flat / flat.std(axis=0)
    return out


SAMPLES = _evenly_spread()
LEAST_SPREAD = 0.01
"""No position is known better than this, m."""


def quadrature_points(spreads: Array) -> Array:
    """(K, 64, 2) m, equally likely offsets from the mean.

    Args:
        spreads: (K, 2, 2) m^2, covariances.
    """
    roots = np.linalg.cholesky(spreads + LEAST_SPREAD**2 * np.eye(2))
    out: Array = SAMPLES @ roots.transpose(0, 2, 1)
    return out
