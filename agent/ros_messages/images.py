"""Images of ROS messages as grey arrays."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.storage.image_file import UsedBits, check_size, decode_grey

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
    "bayer_rggb16": 2,
    "bayer_bggr16": 2,
    "bayer_gbrg16": 2,
    "bayer_grbg16": 2,
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
    "bayer_rggb16": cv2.COLOR_BayerBG2GRAY, "bayer_bggr16": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg16": cv2.COLOR_BayerGR2GRAY, "bayer_grbg16": cv2.COLOR_BayerGB2GRAY,
}  # fmt: skip


class GreyImages:
    """Reads the images of one topic. Of 16 bits a pixel it finds out which are used."""

    def __init__(self, topic: str) -> None:
        """Begin with none.

        Args:
            topic: for the log.
        """
        self._used = UsedBits(topic)

    def read(self, message: Any) -> NDArray[np.uint8]:
        """(H, W) of a sensor_msgs Image or CompressedImage.

        Raises:
            DeviceError: its encoding is not supported, or it is damaged, empty or too large.
        """
        return grey_of(message, self._used)


def grey_of(message: Any, used: UsedBits | None = None) -> NDArray[np.uint8]:
    """(H, W) of a sensor_msgs Image or CompressedImage.

    Args:
        message: the image.
        used: of its topic; None: of 16 bits a pixel the upper eight are read.

    Raises:
        DeviceError: its encoding is not supported, or it is damaged, empty or too large.
    """
    compressed = not hasattr(message, "encoding")
    try:
        if compressed:
            return decode_grey(bytes(message.data), used)
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
    if encoding in LUMA:
        return np.ascontiguousarray(pixels.reshape(height, width, 2)[:, :, LUMA[encoding]])
    if size == 2:
        deep = np.ascontiguousarray(pixels).view(">u2" if message.is_bigendian else "<u2")
        wide = deep.astype(np.uint16)
        pixels = np.asarray(wide >> 8, np.uint8) if used is None else used.eight(wide)
        size = 1
    if encoding not in TO_GREY:
        return np.ascontiguousarray(pixels)
    return np.asarray(cv2.cvtColor(pixels.reshape(height, width, size), TO_GREY[encoding]), np.uint8)
