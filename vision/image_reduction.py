"""Large images are reduced, with their camera: SIFT takes time in proportion to the area."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import Distortion

MOST_PIXELS = 800 * 600
"""Of an image that is worked on; a larger one is reduced to this."""


class ImageSize(NamedTuple):
    """Width and height of an image, px."""

    width: int
    height: int


def reduced_size(width: int, height: int) -> ImageSize:
    """The size at which images of a size are worked on: of the same shape, `MOST_PIXELS` at most."""
    scale = math.sqrt(MOST_PIXELS / (width * height))
    if scale >= 1.0:
        return ImageSize(width, height)
    return ImageSize(max(1, math.floor(scale * width)), max(1, math.floor(scale * height)))


def reduced_image(image: NDArray[np.uint8], size: ImageSize) -> NDArray[np.uint8]:
    """(H, W) grey to another size: each pixel is the mean of the area that it covers."""
    if image.shape == (size.height, size.width):
        return image
    import cv2

    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def reduced_optics(camera: Camera, distortion: Distortion, size: ImageSize) -> tuple[Camera, Distortion]:
    """The ideal camera and the lens of reduced images.

    A fisheye's ideal camera is that which its own reduced lens has, as where the reduced images are recorded.
    """
    if size == (camera.width, camera.height):
        return camera, distortion
    across, down = size.width / camera.width, size.height / camera.height
    if isinstance(distortion, Equidistant):
        lens = distortion.scaled(across, down)
        return lens.ideal(size.width, size.height, camera.mount_height, camera.mount_forward), lens
    small = replace(
        camera,
        width=size.width,
        height=size.height,
        fx=camera.fx * across,
        fy=camera.fy * down,
        # The middle of the first pixel is 0, its edge -0.5.
        cx=(camera.cx + 0.5) * across - 0.5,
        cy=(camera.cy + 0.5) * down - 0.5,
    )
    return small, distortion
