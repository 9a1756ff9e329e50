"""SIFT features of one image, evenly spread and compactly coded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.descriptor import encode
from mapweave.hybridmap.node import CODE_BYTES
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.query import View
from mapweave.vision.lens import Lens

if TYPE_CHECKING:
    import cv2

TEXTURE_BLOCK_PX = 11
"""Side of the square in which texture is measured, about that of a tracked patch."""


@dataclass(frozen=True)
class SiftSettings:
    """How features are chosen.

    Attributes:
        most: features kept of one image.
    """

    most: Annotated[int, Meta(ge=8)] = 150


@dataclass(frozen=True, eq=False)
class Features:
    """The features of one image, strongest first, in columns.

    Attributes:
        raw: (N, 2) px as in the real image.
        pixels: (N, 2) px in the ideal image.
        codes: (N, 32) uint8 compact descriptors.
        responses: (N,) SIFT's response.
    """

    raw: Array
    pixels: Array
    codes: NDArray[np.uint8]
    responses: Array

    def __len__(self) -> int:
        """How many."""
        return len(self.raw)

    def view(self, camera: Camera) -> View:
        """The same as a question to the map."""
        return View(self.pixels.astype(np.float32), self.codes, camera)


LEAST_TEXTURE = 1.5
"""The image's mean squared gradient around a feature, in its weakest direction, (grey/px)^2. On an edge it
is that of noise alone: such a feature slides along the edge when it is tracked (aperture problem),
unnoticed by a forward-backward check."""
LEAST_ROUNDNESS = 0.04
"""The same mean squared gradient in the weakest direction, as a share of that in the strongest."""
CONTRAST = 0.02
"""SIFT's contrast threshold; lower finds more and weaker features."""
NOTHING: Array = np.zeros((0, 4))
CELLS = 4
"""The image is cut into CELLS x CELLS cells;"""
CROWDING = 2.5
"""each may give at most this many times its even share of the features."""
BORDER_PX = 6.0
"""Features nearer to the image's border are left out, as they cannot be tracked, px."""


class Sift:
    """Extracts features; holds OpenCV's detector."""

    def __init__(self, lens: Lens, settings: SiftSettings | None = None) -> None:
        """Take the lens that pixels are freed of."""
        import cv2

        self._lens = lens
        self._settings = settings or SiftSettings()
        # More are asked for than kept, so that the spread has something to choose from.
        self._detector = cv2.SIFT.create(nfeatures=2 * self._settings.most, contrastThreshold=CONTRAST)

    def extract(self, image: NDArray[np.uint8], left_out: Array = NOTHING) -> Features:
        """Find the features of an image.

        Args:
            image: (H, W) grey.
            left_out: (K, 4) px in the ideal image, regions without features: left, top, right, bottom.
        """
        image = self._lens.rectified(image)
        keypoints, descriptors = self.describe(image, left_out)
        if not keypoints:
            return Features(
                np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, CODE_BYTES), np.uint8), np.zeros(0)
            )
        raw = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
        responses = np.array([k.response for k in keypoints], dtype=np.float64)
        codes = encode(descriptors)
        if self._lens.rectifies:
            return Features(self._lens.distort(raw), raw, codes, responses)
        return Features(raw, self._lens.undistort(raw), codes, responses)

    def describe(
        self, image: NDArray[np.uint8], left_out: Array = NOTHING
    ) -> tuple[Sequence[cv2.KeyPoint], NDArray[np.float32]]:
        """The same before they are coded: keypoints, strongest first, and (N, 128) SIFT."""
        # In one call: descriptors of those that are left out cost less than a second image pyramid.
        found, descriptors = self._detector.detectAndCompute(image, None)
        if not found:
            return [], np.zeros((0, 128), np.float32)
        chosen = self._outside(found, self._trackable(found, image), left_out)
        kept = self._spread(found, chosen, image.shape[1], image.shape[0])
        return [found[k] for k in kept], np.asarray(descriptors, np.float32)[kept]

    def _trackable(self, keypoints: Sequence[cv2.KeyPoint], image: NDArray[np.uint8]) -> list[int]:
        """Numbers of those that the image around them holds in both directions (Shi and Tomasi 1994)."""
        import cv2

        smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
        at = np.array([k.pt for k in keypoints]).round().astype(int)
        # The structure tensor of the whole image, and its eigenvalues at the keypoints alone.
        scale = 0.25 / TEXTURE_BLOCK_PX
        x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=scale)
        y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=scale)
        size = (TEXTURE_BLOCK_PX, TEXTURE_BLOCK_PX)
        xx, xy, yy = (
            cv2.boxFilter(product, cv2.CV_32F, size, normalize=False)[at[:, 1], at[:, 0]].astype(float) / 4.0
            for product in (x * x, x * y, y * y)
        )
        middle, half = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
        weak, strong = middle - half, middle + half
        enough = (weak >= LEAST_TEXTURE) & (weak >= LEAST_ROUNDNESS * strong)
        return [int(k) for k in np.flatnonzero(enough)]

    def _outside(self, keypoints: Sequence[cv2.KeyPoint], chosen: list[int], left_out: Array) -> list[int]:
        """Numbers of those that lie in no region that is left out."""
        if not len(left_out) or not chosen:
            return chosen
        at = np.array([keypoints[k].pt for k in chosen], dtype=np.float64)
        pixels = (at if self._lens.rectifies else self._lens.undistort(at))[:, None]
        inside: NDArray[np.bool_] = (pixels >= left_out[:, :2]) & (pixels <= left_out[:, 2:])
        hits = np.any(np.all(inside, axis=2), axis=1).tolist()
        return [k for k, hit in zip(chosen, hits, strict=True) if not hit]

    def _spread(
        self, keypoints: Sequence[cv2.KeyPoint], chosen: Sequence[int], width: int, height: int
    ) -> list[int]:
        """Strongest first, one a place (SIFT repeats a place for each orientation), no cell crowded."""
        s = self._settings
        quota = int(np.ceil(CROWDING * s.most / CELLS**2))
        taken: dict[tuple[int, int], int] = {}
        places: set[tuple[int, int]] = set()
        kept: list[int] = []
        for k in sorted(chosen, key=lambda k: (-keypoints[k].response, keypoints[k].pt)):
            x, y = keypoints[k].pt
            if not (BORDER_PX <= x < width - BORDER_PX and BORDER_PX <= y < height - BORDER_PX):
                continue
            place = (round(x), round(y))
            cell = (int(x * CELLS / width), int(y * CELLS / height))
            if place in places or taken.get(cell, 0) >= quota:
                continue
            places.add(place)
            taken[cell] = taken.get(cell, 0) + 1
            kept.append(k)
            if len(kept) == s.most:
                break
        return kept
