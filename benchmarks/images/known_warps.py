"""Images under known homographies: what matches is right or wrong without asking an estimator."""

from typing import Any

import cv2
import numpy as np
import skimage.data
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array

Image = NDArray[np.uint8]

# Public domain or CC0, each says so in its docstring in skimage.data.
TRAINED_ON = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel", "rocket", "clock")
HELD_OUT = ("coins", "page", "text", "moon", "retina", "hubble_deep_field")


def load(name: str) -> Image:
    """One of scikit-image's images, grey, at most 640 px wide."""
    return shrunk(getattr(skimage.data, name)())


def shrunk(image: NDArray[Any], longest: int = 640) -> Image:
    """An image (H, W) or (H, W, 3) in grey, its longer side at most so many px."""
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = longest / max(image.shape)
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image, dtype=np.uint8)


def warp(image: Image, rng: np.random.Generator) -> tuple[Image, Array]:
    """See the image from elsewhere: turned, nearer or further, oblique, darker, blurred and noisy.

    Returns:
        The other image, of the same size, and the (3, 3) homography from pixels of the first to its own.
    """
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    angle, scale = rng.normal(0, np.deg2rad(7)), np.exp(rng.uniform(np.log(0.55), np.log(1.5)))
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([width, height]) / 2
    moved = (corners - centre) @ turn.T + centre + rng.normal(0, 0.06, (4, 2)) * [width, height] * scale
    b_from_a = cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32))
    warped = cv2.warpPerspective(image, b_from_a, (width, height), flags=cv2.INTER_AREA)
    out = cv2.GaussianBlur(warped, (0, 0), rng.uniform(0.3, 1.2)).astype(np.float64)
    out = out * rng.uniform(0.6, 1.2) + rng.uniform(-20, 20) + rng.normal(0, rng.uniform(1, 5), out.shape)
    return np.clip(out, 0, 255).astype(np.uint8), np.asarray(b_from_a, dtype=np.float64)
