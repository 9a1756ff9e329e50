"""Tracks of image points by pyramidal Lucas-Kanade, checked forward and backward, held to where they began.

From frame to frame, Lucas-Kanade finds a point however it has moved; the patch in which the point was first
seen then says where exactly it is (agent/vision/template.py, docs/decisions/tracking.md).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import lengths
from mapweave.agent.vision.template import TemplateMatcher, Templates
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import Lens

WINDOW_PX = 11
"""Side of the patch that Lucas-Kanade matches, px. Chosen, smaller than OpenCV's 21: it must find the point
again among its neighbours; where exactly it is, its first patch says (docs/decisions/tracking.md)."""
LEVELS = 2
"""Pyramid levels above the image."""
BACKWARD_PX = 0.8
"""A point that does not come back to where it was within this is lost, px."""
BORDER_PX = 4.0
"""Points nearer to the border are lost, px."""
LEAST_TEXTURE = 2.5
"""Mean squared gradient of a patch in its weakest direction, (grey/px)^2; with less (that of noise
included, about 1 for a webcam) a point would slide along an edge, and is lost."""


EIGENVALUE_UNIT = 1024.0
"""OpenCV's Lucas-Kanade measures gradients in units of 1/32 grey/px."""


class Tracker:
    """Follows points from frame to frame. Each has an id that the caller gives.

    Attributes:
        ids: (N,) int64 of the points that are followed now.
        raw: (N, 2) px in the real image, where they are now.
        ages: (N,) int64, images into which they were followed so far.
        held: (N,) whether they were found by the patch in which they were first seen, or from frame to frame
            alone.
    """

    def __init__(self, lens: Lens, anchored: bool = True) -> None:
        """Start with no points.

        Args:
            lens: of the camera.
            anchored: whether points are held to the patches in which they were first seen. What is tracked
                over one frame only gains nothing by it.
        """
        self._lens = lens
        self._anchored = anchored
        self._image: NDArray[np.uint8] | None = None
        self.ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self.raw: Array = np.zeros((0, 2))
        self._undistorted: tuple[Array, Array] = self.raw, self.raw
        self.ages: NDArray[np.int64] = np.zeros(0, np.int64)
        self.held: NDArray[np.bool_] = np.zeros(0, np.bool_)
        self._matcher = TemplateMatcher()
        self._templates = self._matcher.none()
        self._uncut: tuple[NDArray[np.uint8], Array] | None = None

    @property
    def pixels(self) -> Array:
        """(N, 2) px in the ideal image, where the points are now; not to be written to."""
        if self._undistorted[0] is not self.raw:
            pixels = self._lens.undistort(self.raw)
            pixels.flags.writeable = False
            self._undistorted = self.raw, pixels
        return self._undistorted[1]

    @property
    def templates(self) -> Templates:
        """The patches; none if points are not held to any.

        Those of new points are cut when they are first asked for. That is in the tick after: the one that
        ends an episode has waited for features.
        """
        if self._uncut is not None:
            (image, raw), self._uncut = self._uncut, None
            self._templates = self._templates.joined(self._matcher.cut(image, raw))
        return self._templates

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
        start = self.raw.astype(np.float32)[:, None]
        guess = start.copy()
        if expected is not None:
            known = np.isfinite(expected[:, 0]) & np.isfinite(expected[:, 1])
            guess[known, 0] = self._lens.distort(expected[known])
        guess_given = guess.copy()
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
        window = (WINDOW_PX, WINDOW_PX)
        forward, found_forward, _ = cv2.calcOpticalFlowPyrLK(
            before, image, start, guess, winSize=window, maxLevel=LEVELS, criteria=criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=LEAST_TEXTURE / EIGENVALUE_UNIT,
        )  # fmt: skip
        # The way back starts from the expected displacement, not from the answer, which would hide errors.
        way_back = forward - (guess_given - start)
        backward, found_back, _ = cv2.calcOpticalFlowPyrLK(
            image, before, forward, way_back, winSize=window, maxLevel=LEVELS, criteria=criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=LEAST_TEXTURE / EIGENVALUE_UNIT,
        )  # fmt: skip
        height, width = image.shape
        forward, backward = forward[:, 0], backward[:, 0]
        kept = (found_forward[:, 0] == 1) & (found_back[:, 0] == 1)
        kept &= lengths(backward - start[:, 0]) <= BACKWARD_PX
        for along, size in zip(forward.T, (width, height), strict=True):
            kept &= (along >= BORDER_PX) & (along < size - BORDER_PX)
        lost: NDArray[np.int64] = self.ids[~kept]
        self.raw = forward.astype(np.float64)
        self.keep(kept)
        self.ages = self.ages + 1
        if self._anchored:
            match = self._matcher.match(self.templates, image, self.raw)
            self.raw, self.held, self._templates = match.raw, match.held, match.templates
        return lost

    def add(self, ids: NDArray[np.int64], raw: Array, templates: Templates | None = None) -> None:
        """Follow more points of the last image.

        Args:
            ids: (N,) that no point has yet.
            raw: (N, 2) px in the real image.
            templates: their patches if they were seen before; else they are cut from the image.

        Raises:
            InvalidValue: there was no image yet.
        """
        if self._image is None:
            raise InvalidValue("add: points are points of an image; track one first")
        self.ids = np.concatenate([self.ids, ids])
        self.raw = np.concatenate([self.raw, raw])
        self.ages = np.concatenate([self.ages, np.zeros(len(ids), np.int64)])
        self.held = np.concatenate([self.held, np.full(len(ids), self._anchored)])
        if self._anchored:
            held = self.templates
            if templates is None:
                self._uncut = self._image, raw
            else:
                self._templates = held.joined(templates)

    def relight(self, image: NDArray[np.uint8]) -> None:
        """Take the last image as it is in another light: (H, W) grey, from the same place."""
        self._image = image

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Follow only the points that a (N,) mask selects."""
        if mask.all():
            return
        self.ids, self.raw = self.ids[mask], self.raw[mask]
        self.ages, self.held = self.ages[mask], self.held[mask]
        if self._anchored:
            self._templates = self.templates.chosen(mask)

    def clear(self) -> None:
        """Follow nothing."""
        self.keep(np.zeros(len(self.ids), np.bool_))
