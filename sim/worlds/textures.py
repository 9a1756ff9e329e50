"""Textures by name: the painters, plain greys, signs with a text, and picture files."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim import printed_textures as printed
from mapweave.sim import shelving, signage, surface
from mapweave.sim.texture import Image, Painter
from mapweave.storage.image_file import decode_grey, image_size

MAX_IMAGE_PX = 8192
"""Pictures have at most so many pixels across and down."""
MAX_IMAGE_BYTES = 64 * 2**20
"""Picture files are at most so large."""

PaintedWall = Callable[[np.random.Generator, int, int, float], Image]

WALLS: dict[str, PaintedWall] = {
    "wall": surface.wall,
    "plaster": surface.plaster,
    "concrete": surface.concrete,
    "cladding": surface.cladding,
}
"""Painted in the colour of the room that they face."""
PAINTERS: dict[str, Painter] = {
    "wood": surface.wood,
    "desk": surface.desk,
    "cupboard": surface.cupboard,
    "bookshelf": surface.bookshelf,
    "crate": surface.crate,
    "linoleum": surface.linoleum,
    "screed": surface.screed,
    "tiles": surface.tiles,
    "print": printed.framed_print,
    "text": printed.text_page,
    "photograph": printed.photograph,
    "art": printed.geometric_art,
    "mosaic": printed.mosaic,
    "diagram": printed.diagram,
    "door": signage.door,
}
"""Each a picture of its own for each seed."""
WITH_ARGUMENT = {
    "sign": "sign, or sign and a text",
    "grey": "grey and 0 to 255",
    "rack": "rack, or rack changed",
    "carton": "carton",
}
"""Names that something may follow."""
PICTURES = (".png", ".jpg", ".jpeg")
NOTHING = "none"
"""The name of no texture: what has it is not drawn."""


class Textures:
    """Finds painters by name, and reads each picture file once."""

    def __init__(self, folder: Path, common: int) -> None:
        """Start with no picture read.

        Args:
            folder: that relative names of picture files start from.
            common: seed of what is the same all over this world: the contents of racks.
        """
        self._folder = folder
        self._common = common
        self._pictures: dict[str, PictureTexture] = {}

    def painter(self, name: str, paint: float, where: str) -> Painter:
        """The painter of a name.

        Args:
            name: as in a world's file.
            paint: grey of the room's walls.
            where: for the error's text.

        Raises:
            InvalidValue: no such texture, or a picture that cannot be read.
        """
        if name.lower().endswith(PICTURES):
            return self._picture(name, where)
        if name in WALLS:
            return Painted(WALLS[name], paint)
        if name in PAINTERS:
            return PAINTERS[name]
        word, _, argument = name.partition(" ")
        if word == "sign" and len(argument) <= 24:
            return Sign(argument)
        if word == "grey" and argument.isdecimal() and len(argument) <= 3 and int(argument) <= 255:
            return Plain(int(argument))
        if word == "rack" and argument in ("", "changed"):
            return shelving.Rack(self._common, argument == "changed")
        if name == "carton":
            return Carton(self._common)
        names = [*WALLS, *PAINTERS, *WITH_ARGUMENT, NOTHING]
        close = difflib.get_close_matches(word, names, 1)
        if word in WITH_ARGUMENT:
            hint = f"use {WITH_ARGUMENT[word]}"
        else:
            hint = (
                f"did you mean {close[0]!r}?" if close else f"known are {', '.join(names)} and picture files"
            )
        raise InvalidValue(f"{where}: no texture {name!r}; {hint}")

    def _picture(self, name: str, where: str) -> PictureTexture:
        if name not in self._pictures:
            self._pictures[name] = PictureTexture(_read(self._folder / name, where))
        return self._pictures[name]


@dataclass(frozen=True)
class Painted:
    """A wall in the colour of its room."""

    painter: PaintedWall
    paint: float

    def __call__(self, rng: np.random.Generator, width_px: int, height_px: int) -> Image:
        """Paint it."""
        return self.painter(rng, width_px, height_px, self.paint)


@dataclass(frozen=True)
class Sign:
    """A sign with a text."""

    text: str

    def __call__(self, rng: np.random.Generator, width_px: int, height_px: int) -> Image:
        """Paint it."""
        return signage.sign(rng, width_px, height_px, self.text)


@dataclass(frozen=True)
class Carton:
    """Cartons like those in the racks."""

    common: int

    def __call__(self, rng: np.random.Generator, width_px: int, height_px: int) -> Image:
        """Paint them."""
        return shelving.carton(rng, width_px, height_px, self.common)


@dataclass(frozen=True)
class Plain:
    """One grey."""

    grey: int

    def __call__(self, rng: np.random.Generator, width_px: int, height_px: int) -> Image:
        """Paint it."""
        return np.full((height_px, width_px), self.grey, np.uint8)


@dataclass(frozen=True, eq=False)
class PictureTexture:
    """A picture from a file, stretched over the surface."""

    image: Image

    def __call__(self, rng: np.random.Generator, width_px: int, height_px: int) -> Image:
        """Stretch it."""
        smaller = width_px <= self.image.shape[1] and height_px <= self.image.shape[0]
        way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(self.image, (width_px, height_px), interpolation=way), np.uint8)


def _read(path: Path, where: str) -> Image:
    """A picture file in grey.

    Raises:
        InvalidValue: it is missing, too large, or no picture.
    """
    try:
        if path.stat().st_size > MAX_IMAGE_BYTES:
            raise InvalidValue(f"{where}: {path} is larger than {MAX_IMAGE_BYTES >> 20} MiB")
        data = path.read_bytes()
    except FileNotFoundError:
        raise InvalidValue(f"{where}: no picture {path}") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise InvalidValue(f"{where}: {path}: {error}") from None
    try:
        width, height = image_size(data)
        if max(width, height) > MAX_IMAGE_PX:
            raise InvalidValue(f"more than {MAX_IMAGE_PX} pixels across or down")
        return decode_grey(data)
    except InvalidValue as error:
        raise InvalidValue(f"{where}: {path} is no PNG or JPEG picture that can be used ({error})") from None
