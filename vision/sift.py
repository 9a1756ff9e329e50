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
ROUNDING = 1e-4
"""Share of the mean squared gradients within which single precision may be wrong about them."""
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
        import cv2

        maps = _structure(image)
        # In one call: a second image pyramid costs more than descriptors of those that are left out. The mask
        # spares the descriptors of those that the image cannot hold.
        found, descriptors = self._detector.detectAndCompute(image, _likely(maps))
        if not found:
            return [], np.zeros((0, 128), np.float32)
        at = cv2.KeyPoint.convert(found).astype(np.float64)
        chosen = np.flatnonzero(_held(maps, at) & self._outside(at, left_out))
        responses = np.array([k.response for k in found], dtype=np.float64)
        kept = self._spread(chosen, at, responses, image.shape[1], image.shape[0])
        return [found[k] for k in kept], np.asarray(descriptors, np.float32)[kept]

    def _outside(self, at: Array, left_out: Array) -> NDArray[np.bool_]:
        """(N,) which of (N, 2) px lie in no region that is left out."""
        if not len(left_out):
            return np.ones(len(at), np.bool_)
        pixels = (at if self._lens.rectifies else self._lens.undistort(at))[:, None]
        inside: NDArray[np.bool_] = (pixels >= left_out[:, :2]) & (pixels <= left_out[:, 2:])
        return ~np.any(np.all(inside, axis=2), axis=1)

    def _spread(
        self, chosen: NDArray[np.intp], at: Array, responses: Array, width: int, height: int
    ) -> list[int]:
        """Strongest first, one a place (SIFT repeats a place for each orientation), no cell crowded.

        Args:
            chosen: (K,) which of the keypoints may be kept.
            at: (N, 2) px, all keypoints.
            responses: (N,) of them.
            width: of the image, px.
            height: likewise.
        """
        x, y = at[chosen].T
        inner = (x >= BORDER_PX) & (x < width - BORDER_PX) & (y >= BORDER_PX) & (y < height - BORDER_PX)
        order = np.lexsort((y, x, -responses[chosen]))
        chosen = chosen[order[inner[order]]]
        places = at[chosen].round().astype(np.int64).tolist()
        cells = (at[chosen] * CELLS / (width, height)).astype(np.int64).tolist()
        s = self._settings
        quota = int(np.ceil(CROWDING * s.most / CELLS**2))
        taken: dict[tuple[int, int], int] = {}
        before: set[tuple[int, int]] = set()
        kept: list[int] = []
        for k, (column, row), (across, down) in zip(chosen.tolist(), places, cells, strict=True):
            if (column, row) in before or taken.get((across, down), 0) >= quota:
                continue
            before.add((column, row))
            taken[across, down] = taken.get((across, down), 0) + 1
            kept.append(k)
            if len(kept) == s.most:
                break
        return kept


def _structure(image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], ...]:
    """Structure tensor of a grey image (H, W) around each pixel: xx, xy and yy, (H, W) each, times four."""
    import cv2

    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    scale = 0.25 / TEXTURE_BLOCK_PX
    x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=scale)
    y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=scale)
    size = (TEXTURE_BLOCK_PX, TEXTURE_BLOCK_PX)
    return tuple(
        np.asarray(cv2.boxFilter(product, cv2.CV_32F, size, normalize=False), np.float32)
        for product in (x * x, x * y, y * y)
    )


def _likely(maps: tuple[NDArray[np.float32], ...]) -> NDArray[np.uint8]:
    """(H, W) 255 where a keypoint may be one that the image holds, by single precision; else 0."""
    import cv2

    xx, xy, yy = maps
    middle, half = cv2.add(xx, yy), cv2.magnitude(xx - yy, 2.0 * xy)
    weak, slack = middle - half, ROUNDING * middle
    enough = (weak >= 8.0 * LEAST_TEXTURE - slack) & (weak >= LEAST_ROUNDNESS * (middle + half) - slack)
    # OpenCV rounds half a pixel up, and NumPy to the even one.
    return np.asarray(cv2.dilate(enough.astype(np.uint8), np.ones((2, 2), np.uint8), anchor=(1, 1)), np.uint8)


def _held(maps: tuple[NDArray[np.float32], ...], at: Array) -> NDArray[np.bool_]:
    """(N,) whether the image around (N, 2) px holds them in both directions (Shi and Tomasi 1994)."""
    column, row = at.round().astype(int).T
    xx, xy, yy = (part[row, column].astype(float) / 4.0 for part in maps)
    middle, half = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
    weak, strong = middle - half, middle + half
    return np.asarray((weak >= LEAST_TEXTURE) & (weak >= LEAST_ROUNDNESS * strong))
