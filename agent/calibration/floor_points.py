"""Corners of the floor, followed beside the robot's tracks: features of a view are seldom on the floor."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.image_pairs import centres
from mapweave.agent.calibration.pair_information import FLOOR_STEEPNESS
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array

CORNERS = 60
QUALITY, APART_PX = 0.005, 7
WINDOW_PX = 13
BACKWARD_PX = 0.5
"""A point that does not come back to within this is lost."""


class FloorPoints:
    """Corners below the horizon, from where they begin to where they are."""

    def __init__(self, camera: Camera) -> None:
        """Take the camera of the images."""
        self._top = math.ceil(camera.cy + camera.fy * math.tan(FLOOR_STEEPNESS))
        self.clear()

    def clear(self) -> None:
        """Follow nothing."""
        self._image: NDArray[np.uint8] | None = None
        self.begin: Array = np.zeros((0, 2))
        self.here: Array = np.zeros((0, 2))
        self._centre: Array = np.zeros((0, 2))
        self._count = 0

    def start(self, image: NDArray[np.uint8]) -> None:
        """Begin with the corners of an image, (H, W) grey."""
        self.clear()
        if self._top >= image.shape[0] - 16:
            return
        part = np.ascontiguousarray(image[self._top :])
        found = cv2.goodFeaturesToTrack(part, CORNERS, QUALITY, APART_PX)
        if found is not None:
            self._image = image
            self.begin = found[:, 0].astype(np.float64) + np.array([0.0, self._top])
            self._centre = centres(part, found[:, 0].astype(np.float64), WINDOW_PX) - found[:, 0]
            self.here, self._count = self.begin.copy(), len(self.begin)

    def follow(self, image: NDArray[np.uint8]) -> None:
        """Follow them into the next image."""
        before, self._image = self._image, image
        if before is None or not len(self.here) or before.shape != image.shape:
            return
        # What is above the horizon is not needed.
        top = max(self._top - 32, 0)
        one, two = np.ascontiguousarray(before[top:]), np.ascontiguousarray(image[top:])
        start = (self.here - [0.0, top]).astype(np.float32)[:, None]
        there, kept = _followed(one, two, start)
        back, kept_back = _followed(two, one, there)
        kept &= kept_back & (np.linalg.norm((back - start)[:, 0], axis=1) <= BACKWARD_PX)
        place = there[:, 0].astype(np.float64) + np.array([0.0, top])
        height, width = image.shape
        kept &= ((place >= 3) & (place < [width - 3, height - 3])).all(axis=1)
        self.begin, self.here, self._centre = self.begin[kept], place[kept], self._centre[kept]

    @property
    def left(self) -> float:
        """Share that has not left the view or been lost; 1 where there was no floor to begin with."""
        return len(self.here) / self._count if self._count else 1.0

    @property
    def moved(self) -> tuple[Array, Array]:
        """(N, 2) px where they began, and (N, 2) px where they are, each the centre of its gradients."""
        return self.begin + self._centre, self.here + self._centre


def _followed(
    before: NDArray[np.uint8], after: NDArray[np.uint8], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    guess = points.copy()
    window = (WINDOW_PX, WINDOW_PX)
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, points, guess, winSize=window, maxLevel=3)
    return np.asarray(there, np.float32), np.asarray(found[:, 0] == 1)
