"""Whether an image shows anything: exposure, and blur by the measure of Crete et al."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array

PATCH_PX = 11
"""Side of the square in which texture is measured, about that of a tracked patch."""
GRID = (6, 8)
"""Rows and columns of the image's cells, each of which gives at most one corner."""
LEAST_TEXTURE = 8.0
"""Mean squared gradient around a corner in its weakest direction, (grey/px)^2."""
LEAST_CORNERS = 6
"""An image with fewer corners shows nothing."""
BLACK, WHITE = 5, 250
"""Grey levels beyond which a camera is saturated."""
MOST_CLIPPED = 0.5
"""An image of which a larger share is black or white shows nothing."""
LEAST_MEAN = 16.0
"""Grey levels; a darker image has too few left for gradients above its noise."""
MOST_BLUR = 0.72
"""Of `blur_effect`. Sharp images have 0.37 to 0.50 (office in simulation), or 0.55 to 0.68 (a corridor by a
fisheye lens, 9 of 10). Blurred by a Gaussian of 4 px in a width of 320 they have 0.74, or no corners."""
WIDTH_PX = 320
"""Images are brought to this width, so that blur counts by the image rather than by the pixel."""
NEIGHBOURS = 9
"""Taps of the blur that is compared with (Crete et al.)."""


@dataclass(frozen=True)
class ImageQuality:
    """How sharp and how well exposed one image is.

    Attributes:
        mean: grey level.
        corners: strong corners, at most one a cell.
        black: share of its pixels that are saturated.
        white: likewise.
        blur: 0 sharp to 1.
    """

    mean: float
    corners: int
    black: float
    white: float
    blur: float

    @staticmethod
    def of(image: NDArray[np.uint8]) -> ImageQuality:
        """Measure a grey image (H, W)."""
        height, width = image.shape
        black, white = float((image <= BLACK).mean()), float((image >= WHITE).mean())
        if width > WIDTH_PX:
            size = (WIDTH_PX, max(round(height * WIDTH_PX / width), 1))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        smooth = np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0), np.float32)
        corners = len(strongest_corners(image))
        return ImageQuality(float(image.mean()), corners, black, white, blur_effect(smooth))

    @property
    def fault(self) -> str:
        """What is wrong with the image, in words; empty if nothing is."""
        if self.mean < LEAST_MEAN or self.black > MOST_CLIPPED:
            return (
                f"the image is dark (mean grey level {self.mean:.0f}): is the lens covered, or the light off?"
            )
        if self.white > MOST_CLIPPED:
            return f"{self.white:.0%} of the image is white: it is overexposed"
        if self.corners < LEAST_CORNERS:
            return (
                f"the image shows almost nothing to track ({self.corners} corners): is the lens covered "
                "or out of focus, or a bare wall ahead?"
            )
        if self.blur > MOST_BLUR:
            return f"the image is blurred ({self.blur:.2f}, sharp is below {MOST_BLUR}): focus the lens"
        return ""


def strongest_corners(image: NDArray[np.uint8]) -> Array:
    """(N, 2) px: the strongest corner of each cell of a grey image (H, W) that has one."""
    strength = cv2.cornerMinEigenVal(cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32), PATCH_PX)
    rows, columns = (side // n for side, n in zip(image.shape, GRID, strict=True))
    cropped = strength[: rows * GRID[0], : columns * GRID[1]].reshape(GRID[0], rows, GRID[1], columns)
    cells = cropped.transpose(0, 2, 1, 3).reshape(GRID[0] * GRID[1], rows * columns)
    best, cell = cells.argmax(axis=1), np.arange(len(cells))
    # OpenCV sums (2 * gradient / block)^2 over the block: four times the mean.
    strong = cells[cell, best] / 4.0 >= LEAST_TEXTURE
    x = cell % GRID[1] * columns + best % columns
    y = cell // GRID[1] * rows + best // columns
    corners: Array = np.stack([x, y], axis=1)[strong].astype(np.float64)
    return corners


def blur_effect(image: NDArray[np.float32]) -> float:
    """How little a further blur changes a grey image (H, W), 0 (much, it is sharp) to 1.

    Crete, Dolmiere, Ladret, Nicolas: "The blur effect: perception and estimation with a new no-reference
    perceptual blur metric", SPIE 6492 (2007). The larger of both directions.
    """
    worst = 0.0
    for axis, size in ((0, (1, NEIGHBOURS)), (1, (NEIGHBOURS, 1))):
        blurred = cv2.blur(image, size, borderType=cv2.BORDER_REFLECT)
        sharp = np.abs(np.diff(image, axis=axis))
        left = np.abs(np.diff(np.asarray(blurred, np.float32), axis=axis))
        total = float(sharp.sum(dtype=np.float64))
        lost = float(np.maximum(sharp - left, 0.0).sum(dtype=np.float64))
        worst = max(worst, (total - lost) / total if total > 0.0 else 1.0)
    return worst
