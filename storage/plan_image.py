"""Images of floor plans: any image is kept as a PNG of 8 bits, and named by its content."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.floor_plan import MAX_BYTES, MAX_SIDE, PlanImage
from mapweave.storage.atomic_file import read_whole
from mapweave.storage.image_file import check_cost, image_size, to_end
from mapweave.storage.os_errors import unreadable

WITH_ALPHA = (4, 6)
"""Colour types of PNG files with transparency."""
STRIP = 64
"""Rows that are worked on at once."""


@dataclass(frozen=True, eq=False)
class PlanFile:
    """An image as it is kept.

    Attributes:
        image: its name and size.
        png: the file.
    """

    image: PlanImage
    png: bytes


def read_plan_file(path: Path, negate: bool = False) -> PlanFile:
    """Read an image.

    Args:
        path: of a PNG, JPEG, PGM or BMP file.
        negate: exchange light and dark, as a map.yaml says.

    Raises:
        InvalidFile: it cannot be read, is none of these, damaged or too large.
    """
    try:
        data = read_whole(path)
    except OSError as error:
        raise unreadable(path, error) from None
    try:
        return plan_file(data, path.name, negate)
    except InvalidValue as error:
        raise InvalidFile(f"{path}: {error}") from None


def plan_file(data: bytes, name: str = "", negate: bool = False) -> PlanFile:
    """The bytes of an image file as it is kept.

    Raises:
        InvalidValue: they are no image, damaged or too large.
    """
    import cv2

    check_cost(data)
    if max(image_size(data)) > MAX_SIDE:
        raise InvalidValue(f"a plan has at most {MAX_SIDE} px a side: make it smaller")
    pixels = _pixels(data)
    done, png = cv2.imencode(".png", 255 - pixels if negate else pixels, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done or len(png) > MAX_BYTES:
        raise InvalidValue(f"the plan takes more than {MAX_BYTES >> 20} MiB as PNG: make it smaller")
    packed = png.tobytes()
    height, width = pixels.shape[:2]
    return PlanFile(PlanImage(hashlib.sha256(packed).hexdigest(), width, height, name[-255:]), packed)


def check_plan_png(data: bytes) -> PlanImage:
    """The name and size of the bytes of a kept image; its pixels are not decoded.

    Raises:
        InvalidValue: they are no PNG file, or too large.
    """
    if len(data) > MAX_BYTES or not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise InvalidValue(f"a plan is a PNG file of at most {MAX_BYTES >> 20} MiB")
    check_cost(data)
    width, height = image_size(data)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise InvalidValue(f"a plan has at most {MAX_SIDE} px a side")
    return PlanImage(hashlib.sha256(data).hexdigest(), width, height)


def plan_pixels(png: bytes) -> NDArray[np.uint8]:
    """The pixels of a kept image: (H, W) grey or (H, W, 3) red, green, blue.

    Raises:
        InvalidValue: it is damaged.
    """
    check_cost(png)
    pixels = _pixels(png)
    return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[:, :, ::-1])


def _pixels(data: bytes) -> NDArray[np.uint8]:
    """(H, W) or (H, W, 3) as OpenCV has it, upright; what is transparent is white."""
    import cv2

    png_with_alpha = data.startswith(b"\x89PNG") and len(data) > 25 and _is_transparent(data)
    try:
        flag = cv2.IMREAD_UNCHANGED if png_with_alpha else cv2.IMREAD_ANYCOLOR
        image = cv2.imdecode(np.frombuffer(to_end(data), np.uint8), flag)
    except cv2.error:
        image = None
    if image is None:
        raise InvalidValue("the image is damaged")
    if image.dtype == np.uint16:
        image = np.right_shift(image, 8, out=image).astype(np.uint8)
    if png_with_alpha and image.ndim == 3 and image.shape[2] in (2, 4):
        image = _on_white(np.asarray(image, np.uint8))
    return np.asarray(image[:, :, 0] if image.ndim == 3 and image.shape[2] == 1 else image, np.uint8)


def _on_white(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, C) of (H, W, C + 1), whose last channel is how opaque each pixel is."""
    out = np.empty((*image.shape[:2], image.shape[2] - 1), np.uint8)
    # All rows at once would take eight times the memory of the image.
    for top in range(0, len(image), STRIP):
        strip = image[top : top + STRIP]
        alpha = strip[:, :, -1:].astype(np.float32) / 255.0
        out[top : top + STRIP] = np.rint(strip[:, :, :-1] * alpha + 255.0 * (1.0 - alpha))
    return out


def _is_transparent(png: bytes) -> bool:
    """Whether it has a channel of transparency, or a colour of its palette is transparent."""
    return png[25] in WITH_ALPHA or b"tRNS" in png[: png.find(b"IDAT")]
