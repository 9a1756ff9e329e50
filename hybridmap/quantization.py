"""The grid on which landmarks are kept and sent: pixels, depths and their uncertainty as small whole numbers.

A robot rounds a node's landmarks when it makes the node (`settle`), so it works with the same numbers as all
receivers, and stores them in the order that costs least: by rows.

    x, y     steps of 1/8 px, or what fits into 16 bits, from half an image left of and above the image
    share    0: depth not known; else sigma = depth * SHARE_LEAST * exp((share - 1) / 8)
    depth    whole steps from 1 cm in its logarithm, 4 * 2^k to a factor of e; k is the least with steps of at
             most a third of sigma / depth. An uncertain depth needs fewer bits

Errors: pixel half a step, sigma 6.5 % of itself, depth a sixth of its sigma at most, a tenth on average.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.landmark_tables import SYMBOLS
from mapweave.hybridmap.node import Landmarks

FINEST_SHIFT = 3
"""Steps of 2^-3 px: the rounding is a tenth of what SIFT and tracks are off by."""

CELLS_PER_E = 4
CELLS = 14 * CELLS_PER_E
"""Coarse cells of depth: a factor of e^14, so many in each e."""

DEPTH_LEAST = 0.01
"""m. Chosen: nearer things are within the lens."""
DEPTH_MOST = DEPTH_LEAST * math.exp(CELLS / CELLS_PER_E)
"""12 km; a depth beyond is as good as unknown."""

SHARE_LEAST = 0.002
"""Least sigma of a depth as a share of it. 2 mm at 1 m."""
SHARES_PER_E = 8
"""Steps of the share in each factor e: 13 % a step."""
FINE_BITS = np.array(
    [0]
    + [
        max(0, math.ceil(math.log2(3 / (CELLS_PER_E * SHARE_LEAST)) - step / SHARES_PER_E / math.log(2)))
        for step in range(SYMBOLS - 1)
    ]
)
"""k of each share."""
STEPS_PER_E = CELLS_PER_E << FINE_BITS
"""Of the depth, by the share."""
SHARES = SHARE_LEAST * np.exp((np.arange(SYMBOLS) - 1) / SHARES_PER_E)
"""Sigma as a share of the depth."""


@dataclass(frozen=True, eq=False)
class QuantizedLandmarks:
    """Landmarks as whole numbers, N of each.

    Attributes:
        x: int64, 0 to 65535.
        y: int64, likewise.
        share: int64, 0 to 63; see above.
        depth: int64, 0 where the share is 0.
    """

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    share: NDArray[np.int64]
    depth: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PixelGrid:
    """The grid of steps 2^-k px on which a camera's pixels are kept.

    It reaches over the image's border by half the image on each side: removing lens distortion moves pixels
    outwards.

    Attributes:
        shift: k; a step is 2^-k px.
        margin_x: half the image's width, px.
        margin_y: half the image's height, px.
    """

    shift: int
    margin_x: int
    margin_y: int

    @staticmethod
    def of(camera: Camera) -> PixelGrid:
        """The grid for a camera's images: as fine as wanted, if it fits into 16 bits."""
        reach = 2 * max(camera.width, camera.height)
        finest = min((65535 // reach).bit_length() - 1, FINEST_SHIFT)
        return PixelGrid(finest, camera.width // 2, camera.height // 2)

    def round(self, pixels: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Steps x and y of (N, 2) px.

        Raises:
            InvalidValue: a pixel is not finite or farther from the image than half its size.
        """
        from_margin = np.asarray(pixels, np.float64) + np.array([self.margin_x, self.margin_y])
        grid = np.rint(from_margin * 2.0**self.shift)
        # Written so that NaN fails.
        if not ((grid >= 0) & (grid <= 65535)).all():
            raise InvalidValue("landmarks: a pixel is not finite or far outside the image")
        whole = grid.astype(np.int64)
        return whole[:, 0], whole[:, 1]

    def restore(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
        """(N, 2) px of steps."""
        # Exact in float32: 16 bits scaled by a power of two, less a small integer.
        pixels = np.empty((len(x), 2), np.float32)
        pixels[:, 0] = x * 2.0**-self.shift - self.margin_x
        pixels[:, 1] = y * 2.0**-self.shift - self.margin_y
        return pixels


def round_depths(depths: NDArray[Any], sigmas: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Share and depth steps of (N,) m; depths outside 1 cm .. 12 km become unknown, shares are cut off.

    Raises:
        InvalidValue: a depth that is not positive, or one without sigma.
    """
    depths, sigmas = np.asarray(depths, np.float64), np.asarray(sigmas, np.float64)
    if (depths <= 0).any():
        raise InvalidValue("landmarks: a depth is not positive")
    measured = (depths >= DEPTH_LEAST) & (depths < DEPTH_MOST)
    some, spread = depths[measured], sigmas[measured]
    if not (np.isfinite(spread) & (spread >= 0)).all():
        raise InvalidValue("landmarks: a depth has no finite sigma")
    share, depth = np.zeros(len(depths), np.int64), np.zeros(len(depths), np.int64)
    with np.errstate(divide="ignore"):
        steps = 1 + np.rint(SHARES_PER_E * np.log(spread / some / SHARE_LEAST))
    share[measured] = np.clip(steps, 1, SYMBOLS - 1).astype(np.int64)
    steps_a_cell = 1 << FINE_BITS[share[measured]]
    steps = np.floor(np.log(some / DEPTH_LEAST) * CELLS_PER_E * steps_a_cell)
    depth[measured] = np.clip(steps, 0, CELLS * steps_a_cell - 1).astype(np.int64)
    return share, depth


def restore_depths(
    share: NDArray[np.int64], depth: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depths and their sigmas, (N,) m, of steps: the middle of each step."""
    depths = DEPTH_LEAST * np.exp((depth + 0.5) / STEPS_PER_E[share])
    depths[share == 0] = np.nan
    return depths.astype(np.float32), (depths * SHARES[share]).astype(np.float32)


def round_landmarks(landmarks: Landmarks, camera: Camera) -> QuantizedLandmarks:
    """Round.

    Raises:
        InvalidValue: a pixel off the image, a depth that is not positive, or one without sigma.
    """
    x, y = PixelGrid.of(camera).round(landmarks.pixels)
    return QuantizedLandmarks(x, y, *round_depths(landmarks.depths, landmarks.depth_sigmas))


def restore_landmarks(rounded: QuantizedLandmarks, codes: NDArray[np.uint8], camera: Camera) -> Landmarks:
    """Rounded landmarks as all receivers have them."""
    pixels = PixelGrid.of(camera).restore(rounded.x, rounded.y)
    return Landmarks(pixels, codes, *restore_depths(rounded.share, rounded.depth))


def snap(landmarks: Landmarks, camera: Camera) -> Landmarks:
    """Landmarks as all receivers will have them, in the order in which edges refer to them.

    Raises:
        InvalidValue: see `round_landmarks`.
    """
    return restore_landmarks(round_landmarks(landmarks, camera), landmarks.codes, camera)


def settle(landmarks: Landmarks, camera: Camera) -> tuple[Landmarks, NDArray[np.int64]]:
    """The same for a new node: by rows and from left to right, and which each one was.

    Raises:
        InvalidValue: see `round_landmarks`.
    """
    rounded = round_landmarks(landmarks, camera)
    order = np.lexsort((rounded.x, rounded.y))
    return restore_landmarks(rounded, landmarks.codes, camera).take(order), order.astype(np.int64)
