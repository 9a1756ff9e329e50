"""Views of the target: its corners found in an image, and how the board is held in it."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.vision.calibration.target import CalibrationTarget, Pattern

FEWEST_CORNERS = 8
"""Of a view; a pose has six numbers, and four corners fit any homography."""
LEAST_WIDTH = 640
"""px; smaller images are enlarged first: markers of a few pixels are not found otherwise."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """A view of the target.

    Attributes:
        image_size: width and height, px.
        ids: (N,) numbers of the corners that are seen.
        points: (N, 3) m, where they are on the target.
        pixels: (N, 2) px, where they are in the image.
        placement: (4,) how the board is held, see `placement_of`.
        name: of the image, for people.
    """

    image_size: tuple[int, int]
    ids: NDArray[np.int64]
    points: Array
    pixels: Array
    placement: Array
    name: str = ""


class BoardDetector:
    """Finds the target in images."""

    def __init__(self, target: CalibrationTarget) -> None:
        """Prepare OpenCV's detector."""
        self.target = target
        self._charuco = cv2.aruco.CharucoDetector(target.board) if target.pattern is Pattern.CHARUCO else None

    def find(self, image: NDArray[np.uint8], name: str = "") -> BoardView | None:
        """The view in a grey image (H, W), or None if too little of the target is seen."""
        shape = image.shape[1], image.shape[0]
        factor = max(1, math.ceil(LEAST_WIDTH / shape[0]))
        if factor > 1:
            large = factor * shape[0], factor * shape[1]
            image = np.asarray(cv2.resize(image, large, interpolation=cv2.INTER_CUBIC), np.uint8)
        numbers = np.arange(len(self.target.corners))
        if self._charuco is not None:
            found, ids, _, _ = self._charuco.detectBoard(image)
            if ids is None or len(ids) < FEWEST_CORNERS:
                return None
            numbers, pixels = ids.ravel().astype(np.int64), found.reshape(-1, 2)
        else:
            size = self.target.columns - 1, self.target.rows - 1
            good, found = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
            if not good:
                return None
            pixels = found.reshape(-1, 2)
        # The middle of the first pixel is 0.
        at: Array = (np.asarray(pixels, np.float64) + 0.5) / factor - 0.5
        corners = self.target.corners[numbers]
        spread = np.linalg.svd(corners[:, :2] - corners[:, :2].mean(axis=0), compute_uv=False)
        if spread[1] < self.target.square:
            return None  # corners on one line tell nothing
        placement = placement_of(self.target, shape, corners, at)
        return None if placement is None else BoardView(shape, numbers, corners, at, placement, name)


def placement_of(
    target: CalibrationTarget, image_size: tuple[int, int], points: Array, pixels: Array
) -> Array | None:
    """How the board is held: its place, size and skew, each from 0 to 1 (as ROS' camera_calibration).

    Args:
        target: the board.
        image_size: px.
        points: (N, 3) m, corners that are seen.
        pixels: (N, 2) px.

    Returns:
        (4,): x and y from 0, at the image's left and upper edge, to 1; the share of the image's side that
        the board takes; skew, 0 with a right angle at its corner and 1 with one of 45 degrees. None if the
        corners do not lie on a plane's picture.
    """
    homography, _ = cv2.findHomography(points[:, :2], pixels)
    if homography is None:
        return None
    # The inner corners: the outer ones of a board that is seen in part may be far out of the image.
    width, height = target.size
    s = target.square
    outer = np.array([[s, s], [width - s, s], [width - s, height - s], [s, height - s]])
    seen = np.column_stack([outer, np.ones(4)]) @ homography.T
    if (seen[:, 2] <= 0).any() and (seen[:, 2] >= 0).any():
        return None
    quad = seen[:, :2] / seen[:, 2:]
    first, second = quad[1] - quad[0], quad[2] - quad[0]
    area = 0.5 * abs(first[0] * second[1] - first[1] * second[0])
    first, second = quad[2] - quad[0], quad[3] - quad[0]
    area += 0.5 * abs(first[0] * second[1] - first[1] * second[0])
    size = math.sqrt(area / (image_size[0] * image_size[1]))
    middle = pixels.mean(axis=0)
    half = np.ptp(pixels, axis=0) / 2
    room = np.maximum(np.array(image_size) - 2 * half, 1.0)
    x, y = np.clip((middle - half) / room, 0.0, 1.0)
    a, b = quad[0] - quad[1], quad[2] - quad[1]
    cosine = float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9))
    skew = min(1.0, 2.0 * abs(math.pi / 2 - math.acos(min(max(cosine, -1.0), 1.0))))
    return np.array([x, y, min(size, 1.0), skew])
