"""Images of nodes as small JPEG files: a robot writes them, and a map server checks what comes of a robot."""

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.view_image import MAX_BYTES, view_size
from mapweave.storage.image_file import decode_grey, image_size

BEGIN, END = b"\xff\xd8\xff", b"\xff\xd9"
QUALITIES = (50, 25, 10)
"""Of JPEG. The first takes 5 to 25 kB; an image of noise needs the others."""


def view_file(pixels: NDArray[np.uint8], camera: Camera) -> bytes:
    """Write the image of a node.

    Args:
        pixels: (H, W) grey, as the ideal camera sees it.
        camera: of the node.

    Returns:
        A JPEG file.

    Raises:
        InvalidValue: it takes too many bytes.
    """
    import cv2

    width, height = view_size(camera)
    if pixels.shape != (height, width):
        pixels = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    for quality in QUALITIES:
        done, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if done and len(jpeg) <= MAX_BYTES:
            return jpeg.tobytes()
    raise InvalidValue(f"the image takes more than {MAX_BYTES >> 10} KiB")


def is_whole(data: bytes) -> bool:
    """Whether a file begins and ends as a JPEG does; one that is cut off does not."""
    return data.startswith(BEGIN) and data.endswith(END) and len(data) <= MAX_BYTES


def checked_view(data: bytes, camera: Camera) -> bytes:
    """Decode what should be the image of a node, and encode it again: nothing else of the file is passed on.

    Args:
        data: a JPEG file; its size is read before it is decoded.
        camera: of the node.

    Raises:
        InvalidValue: it is no whole JPEG file, or not of the size that it should have.
    """
    if not is_whole(data):
        raise InvalidValue(f"no whole JPEG file of at most {MAX_BYTES >> 10} KiB")
    size, right = image_size(data), view_size(camera)
    if size != right:
        raise InvalidValue(f"{size[0]}x{size[1]} px instead of {right[0]}x{right[1]}")
    pixels = decode_grey(data)
    if pixels.shape[::-1] != right:
        raise InvalidValue("its pixels are not as many as its head says")
    return view_file(pixels, camera)
