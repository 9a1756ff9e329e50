"""Whether the camera delivers: new images come, change as the robot moves, and are not all black or white."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import same_image
from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Pose2

LATEST = 0.5
"""s without a new image after which the robot stands. It drives 0.15 m in that time."""
DROPPED = 3
"""Images in a row that any camera may drop."""
MOVED = (0.02, 0.02)
"""Once the wheels have moved this much, m and rad, no camera gives the same image to the last grey level: a
turn by 0.02 rad moves it by 5 px at 320 px."""
BLACK, WHITE = 16.0, 250.0
"""Mean grey levels beyond which an image is all black or white,"""
EVEN = 4.0
"""if it varies by less than this, grey levels. A dim room varies more; a white wall is below `WHITE`."""


class CameraMonitor:
    """Compares each image with the one before and with the wheels.

    A robot that stands before a scene that stands may get the same image for ever: that is no fault.

    Attributes:
        fault: what is wrong, in words; empty if nothing is.
        frozen: whether the last image came before, from elsewhere: it shows nothing of the present.
    """

    def __init__(self, tick: float) -> None:
        """Begin without an image.

        Args:
            tick: time between two observations, s.
        """
        self.fault = ""
        self.frozen = False
        self._tick = tick
        self._patience = max(LATEST, DROPPED * tick)
        self._image: NDArray[np.uint8] | None = None
        self._moved = Pose2()
        self._missing = self._stale = self._empty = 0.0

    def see(self, image: NDArray[np.uint8] | None, odometry: Odometry) -> None:
        """Take in one tick: its image, (H, W) grey or None, and how the wheels have moved."""
        self._moved = self._moved @ odometry.motion()
        if image is None:
            self._missing += self._tick
        else:
            self._missing = 0.0
            self._compare(image)
        self.fault = self._found(image)

    def _compare(self, image: NDArray[np.uint8]) -> None:
        """Whether an image is the last one again, and whether it shows anything."""
        if self._image is not None and same_image(image, self._image):
            way = math.hypot(self._moved.x, self._moved.y)
            moved = way > MOVED[0] or abs(self._moved.heading) > MOVED[1]
            # Only an image with nothing in it is the same from everywhere. A frozen one is until it changes.
            self.frozen = self.frozen or (moved and int(image.min()) < int(image.max()))
        else:
            self._image, self._moved, self.frozen = image, Pose2(), False
        self._stale = self._stale + self._tick if self.frozen else 0.0
        means, spreads = cv2.meanStdDev(image)
        mean, spread = float(means[0, 0]), float(spreads[0, 0])
        empty = spread < EVEN and not BLACK <= mean <= WHITE
        self._empty = self._empty + self._tick if empty else 0.0

    def _found(self, image: NDArray[np.uint8] | None) -> str:
        if self._missing > self._patience:
            return "the camera gives no image: is it connected?"
        if self._stale > self._patience:
            return "the camera gives the same image again and again while the wheels move: it is frozen"
        if image is None:
            return self.fault
        if self._empty > self._patience:
            kind = "black" if float(image.mean()) < BLACK else "white"
            return f"the camera's image is all {kind}: is the lens covered, or the light off or too strong?"
        return ""
