"""Maps of Nav2 and ROS 1: a `map.yaml` beside an image (nav2_map_server, map_server)."""

import io
import reprlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.limits import MAX_FLOAT
from mapweave.hybridmap.pose import Pose2
from mapweave.storage.atomic_file import read_whole
from mapweave.storage.os_errors import unreadable

MAX_BYTES = 8192
"""A map.yaml has ten lines; the parser takes time by the square of what is nested."""
SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True, slots=True)
class Nav2Map:
    """What a map.yaml says.

    Attributes:
        image: path of the image.
        resolution: m in a pixel.
        origin: pose of the lower left corner of the image in the frame of the map.
        negate: whether light pixels are occupied.
        occupied_thresh: share of black from which a pixel is occupied.
        free_thresh: share of black up to which it is free.
    """

    image: Path
    resolution: float
    origin: Pose2
    negate: bool = False
    occupied_thresh: float = 0.65
    free_thresh: float = 0.25


def read_nav2_map(path: Path) -> Nav2Map:
    """Read a map.yaml; the image is not opened.

    Raises:
        InvalidFile: it cannot be read, or a field is missing or wrong; one line says which.
    """
    try:
        data = read_whole(path)
    except OSError as error:
        raise unreadable(path, error) from None
    return parse_nav2_map(data, path)


def parse_nav2_map(data: bytes, path: Path) -> Nav2Map:
    """The content of a map.yaml.

    Args:
        data: the file.
        path: of the file; the image is beside it.

    Raises:
        InvalidFile: it is no YAML, or a field is missing or wrong; one line says which.
    """
    fields = _fields(path, data)
    image = fields.get("image")
    if not isinstance(image, str) or not image.strip():
        raise InvalidFile(f"{path}: has no `image:`, the name of the image file")
    resolution = _number(path, fields, "resolution", None)
    if not 0.0 < resolution < 1e3:
        raise InvalidFile(f"{path}: resolution {resolution:g}: give metres in a pixel, for example 0.05")
    origin = fields.get("origin")
    if not isinstance(origin, list) or len(origin) != 3 or not all(map(_is_number, origin)):
        raise InvalidFile(
            f"{path}: origin {_words(origin)}: give [x, y, yaw], for example [-10.0, -5.2, 0.0]"
        )
    occupied = _number(path, fields, "occupied_thresh", 0.65)
    free = _number(path, fields, "free_thresh", 0.25)
    if not 0.0 <= free < occupied <= 1.0:
        raise InvalidFile(
            f"{path}: free_thresh {free:g} and occupied_thresh {occupied:g}: give 0 <= free < occupied <= 1"
        )
    negate = fields.get("negate", 0)
    if negate not in (0, 1):
        raise InvalidFile(f"{path}: negate {_words(negate)}: give 0 or 1")
    try:
        place = path.parent / Path(image).expanduser()
    except RuntimeError as error:
        raise InvalidFile(f"{path}: image {image!r:.80}: {error}") from None
    return Nav2Map(place, resolution, Pose2(*map(float, origin)), bool(negate), occupied, free)


def _fields(path: Path, data: bytes) -> dict[str, Any]:
    # It is imported here: recordings bring it, and most programs read none.
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    if len(data) > MAX_BYTES:
        raise InvalidFile(f"{path}: is no map.yaml: it has {len(data)} bytes")
    try:
        fields = YAML(typ="safe", pure=True).load(io.BytesIO(data))
    except (YAMLError, ValueError, LookupError, TypeError, RecursionError) as error:
        # A value that is not of its tag, such as `!!bool maybe`, is a LookupError.
        raise InvalidFile(f"{path}: is no YAML ({str(error).split(chr(10))[0]})") from None
    if not isinstance(fields, dict):
        raise InvalidFile(f"{path}: is no map.yaml: it has no fields")
    return fields


def _number(path: Path, fields: dict[str, Any], name: str, default: float | None) -> float:
    value = fields.get(name, default)
    if value is None:
        raise InvalidFile(f"{path}: has no `{name}:`")
    if not _is_number(value):
        raise InvalidFile(f"{path}: {name} {_words(value)}: give a number")
    return float(value)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    # A float of more than 300 digits is infinite; an integer of so many is no float.
    return abs(value) <= MAX_FLOAT


def _words(value: object) -> str:
    """The beginning of a value: with aliases, a few hundred bytes of a file are gigabytes of text."""
    text = reprlib.Repr()
    text.maxlevel = 2
    return text.repr(value)[:80]
