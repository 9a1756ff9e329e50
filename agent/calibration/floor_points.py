"""Corners of the floor, followed beside the robot's tracks: features of a view are seldom on the floor."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.image_pairs import centres, corners
from mapweave.agent.calibration.pair_information import FLOOR_STEEPNESS
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array

CORNERS = 60
QUALITY, APART_PX = 0.005, 7
WINDOW_PX = 13
BACKWARD_PX = 0.5
"""A point that does not come back to within this is lost."""
MARGIN_PX = 32
"""Above the horizon; what is higher is not needed."""
CONTRAST = 2
"""By which the image is stretched about its local mean."""


class FloorPoints:
    """Corners below the horizon, from where they begin to where they are."""

    def __init__(self, camera: Camera) -> None:
        """Take the camera of the images."""
        self._top = math.ceil(camera.cy + camera.fy * math.tan(FLOOR_STEEPNESS))
        self._above = min(self._top, MARGIN_PX)
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
        part = self._levelled(image)
        found = corners(part[self._above :], CORNERS, QUALITY, APART_PX, WINDOW_PX)
        if len(found):
            self._image = part
            self.begin = found + np.array([0.0, self._top])
            self._centre = centres(part[self._above :], found, WINDOW_PX) - found
            self.here, self._count = self.begin.copy(), len(self.begin)

    def follow(self, image: NDArray[np.uint8]) -> None:
        """Follow them into the next image."""
        if self._image is None or not len(self.here):
            return
        before, self._image = self._image, self._levelled(image)
        top = self._top - self._above
        if before.shape != self._image.shape:
            self.clear()
            return
        start = (self.here - [0.0, top]).astype(np.float32)[:, None]
        there, kept = _followed(before, self._image, start)
        back, kept_back = _followed(self._image, before, there)
        kept &= kept_back & (np.linalg.norm((back - start)[:, 0], axis=1) <= BACKWARD_PX)
        place = there[:, 0].astype(np.float64) + np.array([0.0, top])
        height, width = image.shape
        kept &= ((place >= 3) & (place < [width - 3, height - 3])).all(axis=1)
        self.begin, self.here, self._centre = self.begin[kept], place[kept], self._centre[kept]

    def _levelled(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What matters of an image, without its local mean.

        A floor has little texture: a gain that follows the light passes for motion along the shade of lamps
        and lens. With a simulated phone motions come out 7 % too short; 2 % so.
        """
        part = np.ascontiguousarray(image[self._top - self._above :])
        mean = cv2.blur(part, (WINDOW_PX, WINDOW_PX))
        return np.asarray(cv2.addWeighted(part, CONTRAST, mean, -CONTRAST, 128.0), np.uint8)

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
