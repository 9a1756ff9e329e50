"""Tracks of image points by pyramidal Lucas-Kanade, checked forward and backward."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.vision.lens import Lens
from hybridmap.pose import Array

EIGENVALUE_UNIT = 1024.0
"""OpenCV's Lucas-Kanade measures gradients in units of 1/32 grey/px."""


@dataclass(frozen=True)
class TrackerSettings:
    """How tracks are followed.

    Attributes:
        window_px: side of the patch that is matched.
        levels: pyramid levels above the image.
        backward_px: a point that does not come back to where it was within this is lost.
        border_px: points nearer to the border are lost.
        least_texture: mean squared gradient of a patch in its weakest direction, (grey/px)^2; with less (that
            of noise included, about 1 for a webcam) a point would slide along an edge, and is lost.
    """

    window_px: int = 11
    levels: int = 2
    backward_px: float = 0.8
    border_px: float = 4.0
    least_texture: float = 2.5


class Tracker:
    """Follows points from frame to frame. Each has an id that the caller gives.

    Attributes:
        ids: (N,) int64 of the points that are followed now.
        raw: (N, 2) px in the real image, where they are now.
    """

    def __init__(self, lens: Lens, settings: TrackerSettings | None = None) -> None:
        """Start with no points."""
        self._lens = lens
        self._settings = settings or TrackerSettings()
        self._image: NDArray[np.uint8] | None = None
        self.ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self.raw: Array = np.zeros((0, 2))

    @property
    def pixels(self) -> Array:
        """(N, 2) px in the ideal image, where the points are now."""
        return self._lens.undistort(self.raw)

    def track(self, image: NDArray[np.uint8], expected: Array | None = None) -> NDArray[np.int64]:
        """Follow all points into the next image.

        Args:
            image: (H, W) grey.
            expected: (N, 2) px in the ideal image, where the points are expected; NaN where nothing is
                known. Good expectations let the search be short.

        Returns:
            The ids of the points that were lost.
        """
        before, self._image = self._image, image
        if before is None or not len(self.ids) or before.shape != image.shape:
            everything = self.ids
            self.clear()
            return everything
        s = self._settings
        start = self.raw.astype(np.float32)[:, None]
        guess = start.copy()
        if expected is not None:
            known = np.isfinite(expected).all(axis=1)
            guess[known, 0] = self._lens.distort(expected[known])
        guess_given = guess.copy()
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
        window = (s.window_px, s.window_px)
        there, found, _ = cv2.calcOpticalFlowPyrLK(
            before, image, start, guess, winSize=window, maxLevel=s.levels, criteria=criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=s.least_texture / EIGENVALUE_UNIT,
        )  # fmt: skip
        # The way back starts from the expected displacement, not from the answer, which would hide errors.
        way_back = there - (guess_given - start)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(
            image, before, there, way_back, winSize=window, maxLevel=s.levels, criteria=criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=s.least_texture / EIGENVALUE_UNIT,
        )  # fmt: skip
        height, width = image.shape
        there, back = there[:, 0], back[:, 0]
        kept = (found[:, 0] == 1) & (found_back[:, 0] == 1)
        kept &= np.linalg.norm(back - start[:, 0], axis=1) <= s.backward_px
        kept &= (there >= s.border_px).all(axis=1)
        kept &= (there[:, 0] < width - s.border_px) & (there[:, 1] < height - s.border_px)
        lost: NDArray[np.int64] = self.ids[~kept]
        self.ids, self.raw = self.ids[kept], there[kept].astype(np.float64)
        return lost

    def add(self, ids: NDArray[np.int64], raw: Array) -> None:
        """Follow more points of the last image that was given to `track`."""
        self.ids = np.concatenate([self.ids, ids])
        self.raw = np.concatenate([self.raw, raw])

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Follow only the points that a (N,) mask selects."""
        self.ids, self.raw = self.ids[mask], self.raw[mask]

    def clear(self) -> None:
        """Follow nothing."""
        self.ids, self.raw = self.ids[:0], self.raw[:0]
