"""Images of ROS messages as grey arrays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.storage.image_file import check_size, decode_grey

CHANNELS = {
    "mono8": 1,
    "8uc1": 1,
    "rgb8": 3,
    "bgr8": 3,
    "8uc3": 3,
    "rgba8": 4,
    "bgra8": 4,
    "mono16": 2,
    "16uc1": 2,
}
"""Bytes of a pixel."""
TO_GREY = {
    "rgb8": cv2.COLOR_RGB2GRAY, "bgr8": cv2.COLOR_BGR2GRAY, "8uc3": cv2.COLOR_BGR2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY, "bgra8": cv2.COLOR_BGRA2GRAY,
}  # fmt: skip


def grey_of(message: Any) -> NDArray[np.uint8]:
    """(H, W) of a sensor_msgs Image or CompressedImage.

    Raises:
        DeviceError: its encoding is not supported, or it is damaged, empty or too large.
    """
    try:
        if not hasattr(message, "encoding"):
            return decode_grey(bytes(message.data))
        check_size(int(message.width), int(message.height))
    except InvalidValue as error:
        raise DeviceError(str(error)) from None
    encoding = str(message.encoding).lower()
    if encoding not in CHANNELS:
        raise DeviceError(
            f"images of encoding {message.encoding!r} are not supported; mono8, rgb8 and bgr8 are"
        )
    size, row = CHANNELS[encoding], int(message.step)
    height, width = int(message.height), int(message.width)
    data = np.asarray(message.data, np.uint8)
    if not (width and height) or row < width * size or len(data) < height * row:
        raise DeviceError(f"an image of {width}x{height} px has {len(data)} bytes")
    pixels = data[: height * row].reshape(height, row)[:, : width * size]
    if encoding in ("mono16", "16uc1"):
        # The more significant byte of each pixel.
        return np.ascontiguousarray(pixels.reshape(height, width, 2)[:, :, 0 if message.is_bigendian else 1])
    if size == 1:
        return np.ascontiguousarray(pixels)
    return np.asarray(cv2.cvtColor(pixels.reshape(height, width, size), TO_GREY[encoding]), np.uint8)
