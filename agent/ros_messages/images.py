"""Images of ROS messages as grey arrays."""

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
    "yuv422": 2,
    "uyvy": 2,
    "yuv422_yuy2": 2,
    "yuyv": 2,
    "bayer_rggb8": 1,
    "bayer_bggr8": 1,
    "bayer_gbrg8": 1,
    "bayer_grbg8": 1,
}
"""Bytes of a pixel."""
LUMA = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
"""Which byte of a pixel is how bright it is, of images as many webcams give them."""
TO_GREY = {
    "rgb8": cv2.COLOR_RGB2GRAY, "bgr8": cv2.COLOR_BGR2GRAY, "8uc3": cv2.COLOR_BGR2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY, "bgra8": cv2.COLOR_BGRA2GRAY,
    # OpenCV names a pattern by the second row and column, ROS by the first.
    "bayer_rggb8": cv2.COLOR_BayerBG2GRAY, "bayer_bggr8": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg8": cv2.COLOR_BayerGR2GRAY, "bayer_grbg8": cv2.COLOR_BayerGB2GRAY,
}  # fmt: skip


def grey_of(message: Any) -> NDArray[np.uint8]:
    """(H, W) of a sensor_msgs Image or CompressedImage.

    Raises:
        DeviceError: its encoding is not supported, or it is damaged, empty or too large.
    """
    compressed = not hasattr(message, "encoding")
    try:
        if compressed:
            return decode_grey(bytes(message.data))
        check_size(int(message.width), int(message.height))
    except InvalidValue as error:
        named = f"of format {str(message.format)[:40]!r}: " if compressed else ""
        raise DeviceError(f"{named}{error}") from None
    encoding = str(message.encoding).lower()
    if encoding not in CHANNELS:
        raise DeviceError(
            f"images of encoding {message.encoding!r} are not supported; {', '.join(CHANNELS)} are"
        )
    size, row = CHANNELS[encoding], int(message.step)
    height, width = int(message.height), int(message.width)
    data = np.asarray(message.data, np.uint8)
    if not (width and height) or row < width * size or len(data) < height * row:
        raise DeviceError(f"an image of {width}x{height} px has {len(data)} bytes")
    pixels = data[: height * row].reshape(height, row)[:, : width * size]
    if size == 2:
        # Of 16 bits, the more significant byte of each pixel.
        byte = LUMA.get(encoding, 0 if message.is_bigendian else 1)
        return np.ascontiguousarray(pixels.reshape(height, width, 2)[:, :, byte])
    if encoding not in TO_GREY:
        return np.ascontiguousarray(pixels)
    return np.asarray(cv2.cvtColor(pixels.reshape(height, width, size), TO_GREY[encoding]), np.uint8)
