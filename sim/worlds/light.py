"""The light of lamps under the ceiling, painted onto what they shine on."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.sim.texture import Image, Painter

Vector = tuple[float, float, float]

AMBIENT = 0.65
"""Brightness that walls and floor throw at each other; lamps add the rest."""
FULL = 0.15
"""Light at which a surface is as bright as its painter meant it: about 2 m from one lamp, 1/m^2."""
MOST = 1.3
"""Right below a lamp nothing is brighter than this."""
STEP = 0.12
"""Brightness is computed at points this far apart, and linear between, m."""


@dataclass(frozen=True)
class Lit:
    """A painter whose picture hangs in the light of some lamps.

    Light falls off with the square of the distance and with the angles at the lamp and at the surface
    (Lambert's law for both). It is computed in the frame of a room, so that two rooms with the same lamps
    and the same things at the same places are lit the same to the last bit.

    Attributes:
        painter: of the picture.
        corner: upper left of the surface, m, in the room.
        along: to its upper right corner, m.
        down: to its lower left corner, m.
        lamps: m, in the room.
    """

    painter: Painter
    corner: Vector
    along: Vector
    down: Vector
    lamps: tuple[Vector, ...]

    def __call__(self, rng: np.random.Generator, width_px: int, height_px: int) -> Image:
        """Paint, and light it."""
        picture = self.painter(rng, width_px, height_px)
        columns = max(2, round(float(np.linalg.norm(self.along)) / STEP))
        rows = max(2, round(float(np.linalg.norm(self.down)) / STEP))
        coarse = self.brightness(columns, rows).astype(np.float32)
        bright = _stretched(_stretched(coarse, height_px).T, width_px).T
        return np.asarray(np.clip(picture * bright + 0.5, 0.0, 255.0), np.uint8)

    def brightness(self, columns: int, rows: int) -> Array:
        """(rows, columns) share of the painter's grey, at points from corner to corner."""
        corner, along, down = (np.array(v) for v in (self.corner, self.along, self.down))
        p, q = np.linspace(0.0, 1.0, columns), np.linspace(0.0, 1.0, rows)
        points = corner + p[None, :, None] * along + q[:, None, None] * down
        normal = -np.cross(along, down)
        normal /= np.linalg.norm(normal)
        light = np.zeros((rows, columns))
        for lamp in self.lamps:
            ray = np.array(lamp) - points
            square = (ray**2).sum(axis=-1) + 0.05
            at_surface = np.maximum((ray * normal).sum(axis=-1), 0.0)
            at_lamp = np.maximum(ray[..., 2], 0.0)
            # A lamp also throws light sideways: the shares of a disc that shines down and of a bulb.
            light += at_surface / square**1.5 * (0.4 + 0.6 * at_lamp / np.sqrt(square))
        bright: Array = np.minimum(AMBIENT + (1.0 - AMBIENT) * light / FULL, MOST)
        return bright


def _stretched(values: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Rows between rows, linear, (count, N): the first and the last are the ends of (n, N) values."""
    place = np.linspace(0.0, len(values) - 1.0, count)
    before = np.minimum(place.astype(np.intp), len(values) - 2)
    share = (place - before).astype(np.float32)[:, None]
    return np.asarray(values[before] * (1 - share) + values[before + 1] * share, np.float32)
