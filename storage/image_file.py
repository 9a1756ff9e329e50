"""Images on disk, as recordings and people bring them. Their size is read before they are decoded."""

import logging
import re
import struct
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.storage.atomic_file import read_whole
from mapweave.storage.os_errors import reason_of

log = logging.getLogger(__name__)

DEPTHS = (10, 12, 14, 16)
"""Bits of cameras whose images have 16 bits a pixel."""
MAX_PIXELS = 50_000_000
"""Larger images are refused before they are decoded; phones take up to 50 megapixels."""
MAX_SEGMENTS = 1024
"""Segments of a JPEG before its image. Phones write tens; Exif and colour profiles at most 255 each."""
MAX_SCANS = 20
"""Scans of a progressive JPEG. Encoders write about ten; each one costs a pass over all pixels."""
BARE = (0x00, 0x01, *range(0xD0, 0xDA))
"""Markers of a JPEG that have no segment: none belongs before the image."""
PNG = b"\x89PNG\r\n\x1a\n"
ANIMATION = (b"acTL", b"fcTL", b"fdAT")
"""Chunks of an animated PNG that a still one does not have."""
NO_IMAGE = "no JPEG, PNG, PGM or BMP file; convert it to PNG"
PNM = re.compile(rb"P[1-6](?:\s|#[^\r\n]*[\r\n])+(\d{1,9})\s(?:\s|#[^\r\n]*[\r\n])*(\d{1,9})\s")
"""As the decoder reads it. What stands between the numbers must match in one way, or this takes for ever."""


class UsedBits:
    """How many bits of 16 the images of one camera use: sensors of 10, 12 or 14 bits fill the lower ones.

    It grows with the brightest pixel so far, and never shrinks, so that an image after a brighter one is as
    dark as it is. The first images of a drive may be brighter than the same later.
    """

    def __init__(self, source: str) -> None:
        """Begin with the fewest.

        Args:
            source: of the images, for the log.
        """
        self._source, self._bits = source, 0

    def eight(self, image: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """(H, W) the upper eight of the bits that are used."""
        needed = int(image.max(initial=0)).bit_length()
        bits = next(depth for depth in DEPTHS if depth >= needed)
        if bits > self._bits:
            self._bits = bits
            if bits < DEPTHS[-1]:
                log.info(
                    "%s: of 16 bits the images use %d; the upper 8 of these are read", self._source, bits
                )
        return np.asarray(image >> (self._bits - 8), np.uint8)


def read_grey(
    path: str | PathLike[str],
    camera: Camera | None = None,
    source: str = "the camera",
    used: UsedBits | None = None,
) -> NDArray[np.uint8]:
    """Read an image.

    Args:
        path: of a PNG, JPEG, PGM or BMP file.
        camera: that took it, if known.
        source: the source of the size, for the error.
        used: of the recording that it is one of: then of 16 bits those that are used are read.

    Returns:
        (H, W) grey.

    Raises:
        DeviceError: it is not there, no image, too large, or none of the size that the camera takes.
    """
    try:
        data = read_whole(Path(path))
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file") from None
    except OSError as error:
        raise DeviceError(f"{path}: not an image that can be read ({reason_of(error)})") from None
    try:
        image = decode_grey(data, used)
    except InvalidValue as error:
        raise DeviceError(f"{path}: not an image that can be read ({error})") from None
    if camera is not None and image.shape != (camera.height, camera.width):
        height, width = image.shape
        raise DeviceError(
            f"{path}: {width}x{height} px, but {source} gives {camera.width}x{camera.height}; give a "
            "camera.toml of images of this size"
        )
    return image


def decode_grey(data: bytes, used: UsedBits | None = None) -> NDArray[np.uint8]:
    """Decode an image.

    Args:
        data: a whole PNG, JPEG, PGM or BMP file.
        used: of the camera that it is from; None: of 16 bits a pixel the upper eight are read.

    Returns:
        (H, W) grey, upright if the file has the camera's orientation.

    Raises:
        InvalidValue: it is none of these, damaged, or too large or too costly to decode.
    """
    import cv2

    check_cost(data)
    flag = cv2.IMREAD_GRAYSCALE if used is None else cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    try:
        image = cv2.imdecode(np.frombuffer(to_end(data), np.uint8), flag)
    except cv2.error:
        # OpenCV raises for some broken input and returns nothing for other.
        image = None
    if image is None:
        raise InvalidValue("the image is damaged")
    if used is not None and image.dtype == np.uint16:
        return used.eight(np.asarray(image, np.uint16))
    return np.asarray(image, np.uint8)


def check_cost(data: bytes) -> None:
    """Refuse an image that takes long or much memory to decode, by its head.

    Raises:
        InvalidValue: it is too large, or no PNG, JPEG, PGM or BMP.
    """
    check_size(*image_size(data))
    if data.startswith(b"\xff\xd8") and data.count(b"\xff\xda") > MAX_SCANS:
        raise InvalidValue(f"a JPEG of more than {MAX_SCANS} scans takes too long to decode")
    to_end(data)


def check_size(width: int, height: int) -> None:
    """Refuse an image of too many pixels.

    Raises:
        InvalidValue: it is too large.
    """
    if width * height > MAX_PIXELS:
        raise InvalidValue(
            f"an image of {width}x{height} px is too large: at most {MAX_PIXELS / 1e6:g} megapixels"
        )


def to_end(data: bytes) -> bytes:
    """What a decoder may see: a PNG up to its last chunk and without animation, all of any other file.

    It takes as much memory as a chunk claims before it reads it, also of what stands behind the last one. Of
    an animated PNG it takes 12 bytes a pixel, to show its first frame.

    Raises:
        InvalidValue: a chunk is longer than the file.
    """
    if not data.startswith(PNG):
        return data
    kept, begin, at = list[bytes](), 0, len(PNG)
    while at < len(data):
        kind, end = data[at + 4 : at + 8], at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            raise InvalidValue("the image is damaged")
        if kind in ANIMATION:
            kept.append(data[begin:at])
            begin = end
        at = end
        if kind == b"IEND":
            break
    return b"".join([*kept, data[begin:at]])


def image_size(data: bytes) -> tuple[int, int]:
    """Width and height of an image file, px, from its head alone.

    Raises:
        InvalidValue: it is no PNG, JPEG, PGM or BMP.
    """
    if data.startswith(PNG) and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return width, height
    if data.startswith(b"BM") and len(data) >= 26:
        width, height = struct.unpack("<ii", data[18:26])
        return abs(width), abs(height)
    if header := PNM.match(data[:4096]):
        return int(header[1]), int(header[2])
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(data)
    raise InvalidValue(NO_IMAGE)


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """The size of the first frame that a JPEG begins; the segments before it are skipped."""
    at = 2
    for _ in range(MAX_SEGMENTS):
        if at + 9 > len(data) or data[at] != 0xFF:
            break
        kind = data[at + 1]
        if kind in BARE:
            # The decoder goes on behind such a marker: what is skipped here could hide a frame of gigabytes.
            break
        # Start of frame, except the tables that have numbers in between.
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 1 if kind == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise InvalidValue(NO_IMAGE)
