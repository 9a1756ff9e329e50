"""Image pairs of a drive: corners followed by Lucas-Kanade until the view has moved enough."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.pair_information import ImagePair
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import Lens

CORNERS = 300
"""Corners that are followed, half of them below the middle of the image and half above it."""
QUALITY, APART_PX = 0.003, 7
"""Of corners: share of the strongest, and distance from each other."""
LEAST_CORNER = 0.1
"""Smaller eigenvalue of a corner's structure tensor, as a share of the larger; with less it is an edge (Lowe
2004 has the same ratio of 10). Points slide along edges: at the foot of simulated walls two of three points
with 0.02 to 0.1 are more than 1 px off after 0.4 s, one of ten with more."""
WINDOW_PX = 15
"""Side of the patch that is followed, px."""
BACKWARD_PX = 0.5
"""A point that does not come back to within this is lost."""
SHORTEST_S, LONGEST_S = 0.3, 1.0
"""A pair of images is at least and at most so far apart, s."""
ENOUGH_PX = 0.06
"""A pair ends when half of its points have moved this far, as a share of the image's width,"""
LEAST_LEFT = 0.6
"""or no more than this share of them is left;"""
LEAST_TRACKS = 25
"""with fewer it says nothing."""
FEWEST_PAIRS = 20
"""Without so many nothing is estimated. Chosen: these are at most 20 s of driving."""
LEAST_PX = 1.0
"""Half of the points must have moved this far: a robot that stands says nothing."""


def corners(image: NDArray[np.uint8], most: int, quality: float, apart: float, window: int) -> Array:
    """(N, 2) px, at most so many of the strongest corners, none of them on an edge.

    Args:
        image: (H, W) grey.
        most: how many.
        quality: least strength as a share of the strongest.
        apart: least distance between two, px.
        window: in which they are followed, px.
    """
    found = cv2.goodFeaturesToTrack(image, 3 * most, quality, apart)
    if found is None:
        return np.zeros((0, 2))
    points = found[:, 0].astype(np.float64)
    dx, dy = (d.astype(np.float32) for d in cv2.spatialGradient(image))
    column, row = points.round().astype(int).T
    xx, yy, xy = (
        cv2.boxFilter(product, -1, (window, window))[row, column].astype(np.float64)
        for product in (dx * dx, dy * dy, dx * dy)
    )
    half, apart_by = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    return np.asarray(points[half - apart_by > LEAST_CORNER * (half + apart_by)][:most])


def centres(image: NDArray[np.uint8], points: Array, window: int) -> Array:
    """(N, 2) px, the points of which Lucas-Kanade measures the motion, for windows about (N, 2) px.

    A window moves as the middle of its gradients' energy does. Of floor that is the far side, where the
    pattern is dense: taken for the middle of the window it seems 1.3 % slower than it is (rendered room).
    """
    if not len(points):
        return points
    dx, dy = cv2.spatialGradient(image)
    energy = np.square(dx, dtype=np.float32) + np.square(dy, dtype=np.float32) + 1e-3
    y, x = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    column, row = points.round().astype(int).T
    total, across, down = (
        cv2.boxFilter(part, -1, (window, window))[row, column].astype(np.float64)
        for part in (energy, energy * x, energy * y)
    )
    return np.column_stack([across / total, down / total])


class ImagePairs:
    """Follows corners from image to image and gives a pair whenever the view has moved enough.

    Attributes:
        first: (H, W) grey, the image with which the pair begins that is followed now; empty before any.
    """

    def __init__(self, camera: Camera, lens: Lens) -> None:
        """Begin with no image."""
        self._camera, self._lens = camera, lens
        self.first: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._before = self.first
        self._first_s = 0.0
        self._begin: Array = np.zeros((0, 2))
        self._here: NDArray[np.float32] = np.zeros((0, 1, 2), np.float32)
        self._centre: Array = np.zeros((0, 2))
        self._count = 0

    def step(self, stamp_s: float, image: NDArray[np.uint8]) -> ImagePair | None:
        """Take the next image; a pair if one is complete."""
        if self._before.shape != image.shape or not self._follow(image):
            self._start(stamp_s, image)
            return None
        took = stamp_s - self._first_s
        moved = float(np.median(np.linalg.norm(self._here[:, 0] - self._begin, axis=1)))
        full = moved > ENOUGH_PX * self._camera.width or len(self._begin) < LEAST_LEFT * self._count
        if took < SHORTEST_S or not (full or took >= LONGEST_S):
            return None
        pair = None
        if moved >= LEAST_PX:
            focal = [self._camera.fx, self._camera.fy]
            centre = [self._camera.cx, self._camera.cy]
            before = (self._lens.undistort(self._begin + self._centre) - centre) / focal
            after = (self._lens.undistort(self._here[:, 0] + self._centre) - centre) / focal
            pair = ImagePair(self._first_s, stamp_s, before, after)
        self._start(stamp_s, image)
        return pair

    def _start(self, stamp_s: float, image: NDArray[np.uint8]) -> None:
        self.first, self._before, self._first_s = image, image, stamp_s
        middle = image.shape[0] // 2
        upper, lower = (
            corners(part, CORNERS // 2, QUALITY, APART_PX, WINDOW_PX)
            for part in (image[:middle], image[middle:])
        )
        self._begin = np.concatenate([upper, lower + np.array([0.0, middle])])
        self._here = self._begin.astype(np.float32)[:, None]
        self._centre = centres(image, self._begin, WINDOW_PX) - self._begin
        self._count = len(self._begin)

    def _follow(self, image: NDArray[np.uint8]) -> bool:
        """Follow all points into an image; whether enough are left."""
        before, self._before = self._before, image
        if len(self._here) < LEAST_TRACKS:
            return False
        options = {"winSize": (WINDOW_PX, WINDOW_PX), "maxLevel": 3}
        there, found, _ = cv2.calcOpticalFlowPyrLK(before, image, self._here, None, **options)  # type: ignore[call-overload]
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(image, before, there, None, **options)  # type: ignore[call-overload]
        kept = (found[:, 0] == 1) & (found_back[:, 0] == 1)
        kept &= np.linalg.norm(back[:, 0] - self._here[:, 0], axis=1) <= BACKWARD_PX
        height, width = image.shape
        place = there[:, 0]
        kept &= (place >= 3).all(axis=1) & (place[:, 0] < width - 3) & (place[:, 1] < height - 3)
        self._here, self._begin, self._centre = there[kept], self._begin[kept], self._centre[kept]
        return len(self._here) >= LEAST_TRACKS


def sigma_of(camera: Camera, pixels: float = 0.5) -> float:
    """Standard deviation of a track in normalised coordinates."""
    return pixels / math.sqrt(camera.fx * camera.fy)
