"""Kidnap detection: whether an image continues the last one, or the robot was carried off.

Between two frames a robot moves a little, so nearly all points are still visible, near their predictions by
the wheels. In simulated offices, corridors and warehouses, with good and bad cameras, at least 70 % of the
points were found again from frame to frame, a third where a person walked past or the weak points of a bare
wall faded. After a kidnapping it was at most 8 %, or 30 % where the same wall was still ahead.
"""

from enum import Enum, auto

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import lengths
from mapweave.agent.vision.image_quality import BLACK, LEAST_CORNERS, MOST_CLIPPED, WHITE, strongest_corners
from mapweave.agent.vision.tracker import Tracker
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import Lens

LEAST_GAIN, MOST_GAIN = 0.5, 4.0
"""How much a light may change: a darker image has too few grey levels left to be tracked in, and one that is
made much fainter to be like a blank wall shows as little as that."""


class FrameOverlap(Enum):
    """What an image shows, compared with one before it."""

    SAME = auto()
    """The same things; or no evidence."""
    STRANGE = auto()
    """Other things."""
    BLANK = auto()
    """Nothing, where there should be something: it is dark, the lens is covered, or the camera dazzled."""


LEAST = 8
"""Points that should be in the image; with fewer there is no verdict."""
FEWEST = 5
"""Corners that should be in the image to say that it shows the same although a few tracks were lost."""
SHARE = 0.45
"""If a smaller share of the expected points is found, the image shows something else."""
BORDER_PX = 12.0
"""Points expected nearer to the border may well have left."""
ASTRAY_PX = 20.0
"""A point found further than this from where it is expected is another one."""
FEW_POINTS = 30
"""With fewer points than this, corners are compared as well."""


class KidnapDetector:
    """Compares two images by the points that are tracked, or by corners where these are too few."""

    def __init__(self, lens: Lens, camera: Camera) -> None:
        """Take the camera."""
        self._lens = lens
        self._camera = camera

    def compare(
        self,
        before: NDArray[np.uint8],
        now: NDArray[np.uint8],
        turn: float,
        expected: Array,
        followed: Array,
    ) -> FrameOverlap:
        """Whether an image shows what the last one predicts.

        Args:
            before: (H, W) an image.
            now: (H, W) a later one.
            turn: rad, by how much the robot has turned in between, by its wheels.
            expected: (N, 2) px in the ideal image, where tracked points of `before` are expected now.
            followed: (N, 2) px, where they were found; NaN for those that were lost.
        """
        if before.shape != now.shape:
            return FrameOverlap.SAME
        same = self._same(expected, followed)
        if same is None:
            same = self._corners_agree(before, now, turn)
        if same is None:
            same = self._corners_agree(now, before, -turn)
        if same is not False:
            return FrameOverlap.SAME
        clipped = float(((now <= BLACK) | (now >= WHITE)).mean()) > MOST_CLIPPED
        inside = int(self._camera.contains(expected, BORDER_PX).sum())
        if LEAST <= inside < FEW_POINTS:
            # A dozen tracks on smooth shapes can all be lost at once; the strongest corners stay. Where
            # neither image has enough of them there is no verdict.
            corners = self._corners_agree(before, now, turn, FEWEST)
            if corners is None and not clipped:
                corners = self._corners_agree(now, before, -turn) is not False
            if corners:
                return FrameOverlap.SAME
        blank = clipped or len(strongest_corners(now)) < LEAST_CORNERS
        return FrameOverlap.BLANK if blank else FrameOverlap.STRANGE

    def _same(self, expected: Array, followed: Array, least: int = LEAST) -> bool | None:
        """Whether enough points are near where they should be; None if too few should be in the image."""
        inside = self._camera.contains(expected, BORDER_PX)
        if inside.sum() < least:
            return None
        near = lengths(followed[inside] - expected[inside]) <= ASTRAY_PX
        return bool(near.mean() >= SHARE)

    def _corners_agree(
        self, before: NDArray[np.uint8], now: NDArray[np.uint8], turn: float, least: int = LEAST
    ) -> bool | None:
        corners = strongest_corners(before)
        if len(corners) < least:
            return None
        # The points live for one step: nothing to hold them to.
        tracker = Tracker(self._lens, anchored=False)
        tracker.track(before)
        tracker.add(np.arange(len(corners), dtype=np.int64), corners)
        expected = turned(self._camera, tracker.pixels, turn)
        tracker.track(now, expected)
        followed = np.full(expected.shape, np.nan)
        followed[tracker.ids] = tracker.pixels
        return self._same(expected, followed, least)


def relit(image: NDArray[np.uint8], like: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image as bright and as rich in contrast as another: a lamp may have been switched."""
    (mean, spread), (wanted, wanted_spread) = (
        (float(picture.mean()), float(picture.std())) for picture in (image, like)
    )
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
