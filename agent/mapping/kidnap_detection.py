"""Whether an image continues the one before: tells a robot that was carried off from one that has driven.

Between two frames a robot moves a little, so nearly all that it saw is still there, near where its wheels
say. In simulated offices, corridors and warehouses, by good cameras and bad ones, at least 70 % of the points
were found again from frame to frame, and a third where somebody walked past. After the robot had been put
elsewhere it was at most 8 %, or 30 % where the same wall was still ahead.
"""

from __future__ import annotations

import math
from enum import Enum, auto

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.settings import TrackerSettings
from mapweave.agent.vision.tracker import Tracker
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import Lens

PATCH_PX = 11
"""Side of the square in which texture is measured, about that of a tracked patch."""

GRID = (6, 8)
"""Rows and columns of the image's cells, each of which gives at most one corner."""

LEAST_GAIN, MOST_GAIN = 0.5, 4.0
"""How much a light may change: a darker image has too few grey levels left to be tracked in, and one that is
made much fainter to be like a blank wall shows as little as that."""

BLACK, WHITE = 5, 250
"""Grey levels beyond which a camera tells nothing any more."""


class FrameOverlap(Enum):
    """What an image shows, compared with one before it."""

    SAME = auto()
    """The same things; or nothing that could tell."""
    STRANGE = auto()
    """Other things."""
    BLANK = auto()
    """Nothing, where there should be something: it is dark, the lens is covered, or the camera dazzled."""


LEAST = 8
"""Points that should be in the image; with fewer nothing is said."""
SHARE = 0.45
"""If a smaller share of the expected points is found, the image shows something else."""
BORDER_PX = 12.0
"""Points expected nearer to the border may well have left."""
ASTRAY_PX = 20.0
"""A point found further than this from where it is expected is another one."""
LEAST_TEXTURE = 8.0
"""Mean squared gradient around a corner in its weakest direction, (grey/px)^2."""
LEAST_CORNERS = 6
"""An image with fewer corners shows nothing."""
MOST_CLIPPED = 0.5
"""An image of which a larger share is black or white shows nothing."""
FEW_POINTS = 30
"""With fewer points than this in the image, all of it is compared besides."""
COARSE = 8
"""Side of the squares over which images are averaged before they are compared as a whole, px."""
ALIKE = 0.95
"""Averaged images are the same if they correlate by more than this,"""
LEAST_SPREAD = 8.0
"""vary by more than this, grey levels (all blank walls are alike),"""
SAME_LIGHT = 10.0
"""and are equally bright on average to within this, grey levels."""


class KidnapDetector:
    """Compares two images by the points that are tracked, or by corners where these are too few."""

    def __init__(self, lens: Lens, camera: Camera, tracker: TrackerSettings) -> None:
        """Take the camera and how its points are tracked."""
        self._lens = lens
        self._camera = camera
        self._tracker = tracker

    def compare(
        self,
        before: NDArray[np.uint8],
        now: NDArray[np.uint8],
        turn: float,
        expected: Array,
        found: Array,
    ) -> FrameOverlap:
        """Tell whether an image shows what the image before leads to expect.

        Args:
            before: (H, W) an image.
            now: (H, W) a later one.
            turn: rad, by how much the robot has turned in between, by its wheels.
            expected: (N, 2) px in the ideal image, where tracked points of `before` are expected now.
            found: (N, 2) px, where they were found; NaN for those that were lost.
        """
        if before.shape != now.shape:
            return FrameOverlap.SAME
        same = self._same(expected, found)
        if same is None:
            same = self._corners_agree(before, now, turn)
        if same is None:
            same = self._corners_agree(now, before, -turn)
        if same is not False:
            return FrameOverlap.SAME
        # A dozen tracks on smooth shapes can all be lost at once; then the whole image has its say.
        inside = int(self._camera.contains(expected, BORDER_PX).sum())
        few = LEAST <= inside < FEW_POINTS
        if few and self._alike(before, now, turn):
            return FrameOverlap.SAME
        clipped = float(((now <= BLACK) | (now >= WHITE)).mean())
        blank = clipped > MOST_CLIPPED or len(self._corners(now)) < LEAST_CORNERS
        return FrameOverlap.BLANK if blank else FrameOverlap.STRANGE

    def _same(self, expected: Array, found: Array) -> bool | None:
        """Whether enough points are near where they should be; None if too few should be in the image."""
        inside = self._camera.contains(expected, BORDER_PX)
        if inside.sum() < LEAST:
            return None
        near = np.linalg.norm(found[inside] - expected[inside], axis=1) <= ASTRAY_PX
        return bool(near.mean() >= SHARE)

    def _alike(self, before: NDArray[np.uint8], now: NDArray[np.uint8], turn: float) -> bool:
        """Whether the images are the same by and large, where smooth shapes leave little to be tracked."""
        height, width = before.shape
        aside = round(self._camera.fx * math.tan(turn))
        if abs(aside) > width // 2:
            return False
        # A turn to the left moves all to the right.
        first = before[:, max(-aside, 0) : width - max(aside, 0)]
        second = now[:, max(aside, 0) : width - max(-aside, 0)]
        size = (first.shape[1] // COARSE, height // COARSE)
        one = cv2.resize(first, size, interpolation=cv2.INTER_AREA).astype(np.float64)
        two = cv2.resize(second, size, interpolation=cv2.INTER_AREA).astype(np.float64)
        if abs(float(one.mean() - two.mean())) > SAME_LIGHT:
            return False
        one, two = one - one.mean(), two - two.mean()
        spread = float(one.std() * two.std())
        return spread > LEAST_SPREAD**2 and float((one * two).mean()) > ALIKE * spread

    def _corners_agree(self, before: NDArray[np.uint8], now: NDArray[np.uint8], turn: float) -> bool | None:
        corners = self._corners(before)
        if len(corners) < LEAST:
            return None
        tracker = Tracker(self._lens, self._tracker)
        tracker.track(before)
        tracker.add(np.arange(len(corners), dtype=np.int64), corners)
        expected = turned(self._camera, tracker.pixels, turn)
        tracker.track(now, expected)
        found = np.full(expected.shape, np.nan)
        found[tracker.ids] = tracker.pixels
        return self._same(expected, found)

    def _corners(self, image: NDArray[np.uint8]) -> Array:
        """(N, 2) px in the real image: the strongest corner of each cell that has one."""
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


def relit(image: NDArray[np.uint8], like: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image as bright and as rich in contrast as another: somebody may have switched a lamp on or off."""
    (mean, spread), (wanted, wanted_spread) = ((float(one.mean()), float(one.std())) for one in (image, like))
    gain = min(max(wanted_spread / max(spread, 1.0), LEAST_GAIN), MOST_GAIN)
    return cv2.convertScaleAbs(image, alpha=gain, beta=wanted - gain * mean).astype(np.uint8, copy=False)


def turned(camera: Camera, pixels: Array, turn: float) -> Array:
    """(N, 2) px where points at (N, 2) px come to be when the robot turns on the spot by `turn`, rad.

    The slope to the side follows exactly; that the height changes a little too is left out.
    """
    slope, tangent = np.tan(camera.bearings(pixels)), np.tan(turn)
    expected = pixels.copy()
    expected[:, 0] = camera.cx - camera.fx * (slope - tangent) / (1 + slope * tangent)
    return expected
