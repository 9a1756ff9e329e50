"""Textures that are painted when first seen and filtered for the size at which they are seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

Painter = Callable[[np.random.Generator, int, int], Image]
"""Paints (height_px, width_px) grey: `painter(rng, width_px, height_px)`. Equal painters paint alike."""

PAINTED = 300
"""Pictures kept for worlds that are built again, as a Gymnasium reset does: an office has 229 (33 MB), and
painting them takes 2.2 s.
"""


@lru_cache(PAINTED)
def painted(painter: Painter, seed: tuple[int, ...], width_px: int, height_px: int) -> Image:
    """What a painter paints from a seed. Nobody may change it."""
    image = np.array(painter(np.random.default_rng(seed), width_px, height_px), np.uint8, order="C")
    image.flags.writeable = False
    return image


@dataclass(eq=False)
class Texture:
    """A grey image on a surface, at every sharpness at which a camera may see it.

    Painted from its own seed when it is first needed, so that unseen parts of a large world cost nothing
    and the picture does not depend on the order in which things are seen.

    Attributes:
        width_px: across.
        height_px: down.
        seed: entropy of the painter's random generator.
        painter: paints it.
    """

    width_px: int
    height_px: int
    seed: tuple[int, ...]
    painter: Painter
    _levels: dict[tuple[int, int], Image] = field(default_factory=dict, repr=False)

    def level(self, across: int, down: int) -> Image:
        """The image halved `across` and `down` times, each axis by itself (a "ripmap").

        A wall seen at a slant is shortened in one axis alone; halving both would blur the other away.
        Sizes that cannot be halved any more stay at one pixel.
        """
        key = (across, down)
        if key not in self._levels:
            self._levels[key] = self._make(across, down)
        return self._levels[key]

    def _make(self, across: int, down: int) -> Image:
        if across == 0 and down == 0:
            return painted(self.painter, self.seed, self.width_px, self.height_px)
        size = (max(1, self.width_px >> across), max(1, self.height_px >> down))
        return np.asarray(cv2.resize(self.level(0, 0), size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    @staticmethod
    def of(image: Image) -> Texture:
        """A texture that is already painted."""
        levels = {(0, 0): np.ascontiguousarray(image, np.uint8)}
        return Texture(image.shape[1], image.shape[0], (0,), lambda _rng, _width, _height: image, levels)

    @staticmethod
    def plain(grey: int) -> Texture:
        """One grey all over."""
        return Texture.of(np.full((4, 4), grey, np.uint8))
