"""A photograph from a phone or a file: what its camera was, and its features as a question to the map."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.query import View
from mapweave.storage.image_file import check_cost, decode_grey
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

LONG_SIDE = 1024
"""Larger images are made so small, px: a robot's image shows things no larger than that."""
LONG_SIDE_FOV = math.radians(69.4)
"""Angle of view along the longer side by default: a 26 mm lens on 36 mm film, as most phones have."""
MOUNT_HEIGHT = 1.4
"""Height of the lens above the floor by default, m: a phone held level before the chest."""

NAMES = ("width", "height", "fx", "fy", "cx", "cy", "hfov", "height_m", "forward_m", "distortion")
ALIASES = {"mount_height": "height_m", "mount_forward": "forward_m"}


@dataclass(frozen=True, eq=False)
class Photo:
    """An image as it came, not decoded yet.

    Attributes:
        data: a JPEG or PNG file.
        optics: values of its camera, by the names of camera.toml (px, m), or `hfov`, the horizontal
            angle of view in degrees, instead of focal lengths. Numbers may be text.
    """

    data: bytes
    optics: Mapping[str, Any]

    def check(self) -> None:
        """Check what can be checked without decoding.

        Raises:
            InvalidValue: it is neither JPEG nor PNG, or too large.
        """
        check_cost(self.data)

    def view(self) -> View:
        """Its features.

        Raises:
            InvalidValue: it cannot be decoded, or its camera cannot be.
        """
        import cv2

        image = decode_grey(self.data)
        # A phone notes in the file how it was held; the decoded image is upright.
        camera, distortion = camera_of(self.optics, image.shape[1], image.shape[0])
        scale = min(LONG_SIDE / max(image.shape), 1.0)
        if scale < 1.0:
            camera = scaled(camera, scale)
            small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
            image = np.asarray(small, np.uint8)
        sift = Sift(Lens(camera, distortion))
        return sift.extract(image).view(camera)


def camera_of(
    optics: Mapping[str, Any], width: int, height: int
) -> tuple[Camera, tuple[float, float, float, float, float]]:
    """The camera of an image of so many pixels, and the five coefficients of its lens.

    Raises:
        InvalidValue: a name is unknown, or a value cannot be.
    """
    given = {ALIASES.get(name, name): value for name, value in optics.items()}
    for name in given:
        if name not in NAMES:
            raise InvalidValue(f"no camera value {name!r}; known are {', '.join((*NAMES, *ALIASES))}")
    numbers = {name: _number(name, value) for name, value in given.items() if name != "distortion"}
    distortion = _distortion(given.get("distortion", (0.0,) * 5))
    meant = numbers.get("width", width), numbers.get("height", height)
    factor = width / meant[0] if meant[0] > 0.0 else 0.0
    if abs(meant[1] * factor - height) > 1.0:
        raise InvalidValue(f"the image is {width}x{height} px, but its camera's {meant[0]:g}x{meant[1]:g}")
    if "fx" in numbers and "hfov" in numbers:
        raise InvalidValue("give fx or hfov, not both")
    if "fx" in numbers:
        fx = factor * numbers["fx"]
    elif "hfov" in numbers:
        if not 1.0 <= numbers["hfov"] <= 170.0:
            raise InvalidValue(f"hfov {numbers['hfov']:g} is no angle of view, 1 to 170 degrees are")
        fx = 0.5 * width / math.tan(0.5 * math.radians(numbers["hfov"]))
    else:
        fx = 0.5 * max(width, height) / math.tan(0.5 * LONG_SIDE_FOV)
    camera = Camera(
        width, height, fx, factor * numbers["fy"] if "fy" in numbers else fx,
        factor * numbers.get("cx", 0.5 * (meant[0] - 1)), factor * numbers.get("cy", 0.5 * (meant[1] - 1)),
        numbers.get("height_m", MOUNT_HEIGHT), numbers.get("forward_m", 0.0),
    )  # fmt: skip
    return camera, distortion


def scaled(camera: Camera, scale: float) -> Camera:
    """The camera of the same image made smaller or larger."""
    width, height = round(scale * camera.width), round(scale * camera.height)
    x, y = width / camera.width, height / camera.height
    # The middle of the first pixel is at 0, its edge at -1/2.
    return Camera(
        width, height, x * camera.fx, y * camera.fy, x * (camera.cx + 0.5) - 0.5, y * (camera.cy + 0.5) - 0.5,
        camera.mount_height, camera.mount_forward,
    )  # fmt: skip


def _number(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if isinstance(value, bool) or not abs(number) <= 1e6:
        least = " of at most a million" if abs(number) > 1e6 else ""
        raise InvalidValue(f"{name} must be a number{least}, not {str(value)[:40]!r}")
    return number


def _distortion(value: Any) -> tuple[float, float, float, float, float]:
    parts = value.split(",") if isinstance(value, str) else value
    if not isinstance(parts, list | tuple) or len(parts) != 5:
        raise InvalidValue("distortion must be five numbers: k1, k2, p1, p2, k3")
    k1, k2, p1, p2, k3 = (_number("distortion", part) for part in parts)
    return k1, k2, p1, p2, k3
