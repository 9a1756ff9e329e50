"""Images on disk, as recordings and people bring them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.errors import DeviceError


def read_grey(path: Path, camera: Camera | None = None, told: str = "the camera") -> NDArray[np.uint8]:
    """Read an image.

    Args:
        path: of a file that OpenCV can read.
        camera: that took it, if known.
        told: who says so, for the error.

    Returns:
        (H, W) grey.

    Raises:
        DeviceError: it is not there, no image, or none of the size that the camera takes.
    """
    if not path.exists():
        raise DeviceError(f"{path}: no such file")
    # OpenCV warns of a missing file on its own, past all logging.
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise DeviceError(f"{path}: not an image that can be read")
    if camera is not None and image.shape != (camera.height, camera.width):
        height, width = image.shape
        raise DeviceError(f"{path}: {width}x{height} px, but {told} says {camera.width}x{camera.height}")
    return np.asarray(image, np.uint8)
