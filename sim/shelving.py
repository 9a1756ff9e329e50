"""Warehouse racks full of cartons: few designs, used again and again."""

import functools
import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from mapweave.sim.image_noise import clouds
from mapweave.sim.printed_textures import geometric_art, text_page
from mapweave.sim.signage import sign, write
from mapweave.sim.texture import Image

DESIGNS = 5
"""Kinds of carton in one warehouse."""
COLUMNS = 12
"""Of cartons that are tried on one board."""
CHANGED = 0.35
"""Share of the cartons by which a changed rack differs from the common one."""


@dataclass(frozen=True)
class Rack:
    """The open side of one bay: uprights, beams, and cartons on its boards.

    All racks of one warehouse have the same steel and, but for a few cartons, the same load.

    Attributes:
        common: seed of the load that all racks share.
        changed: whether some cartons are others, by the seed of the texture.
    """

    common: int
    changed: bool

    def __call__(self, rng: np.random.Generator, width_px: int, height_px: int) -> Image:
        """Paint the bay."""
        dark = clouds(np.random.default_rng([self.common, 0xDA4C]), width_px, height_px, 1.4)
        canvas = np.clip(46 + 6 * dark, 0, 255).astype(np.uint8)
        post = max(6, width_px // 26)
        levels = max(2, round(height_px / 190))
        rise = height_px / levels
        for level in range(levels):
            bottom = height_px - int(level * rise) - (14 if level else 8)
            load = np.random.default_rng([self.common, 0xB0CE5, level])
            self._load(canvas, load, rng, (post + 4, width_px - post - 4, bottom, int(rise) - 34))
            beam = bottom + 1
            cv2.rectangle(canvas, (0, beam), (width_px - 1, min(beam + 12, height_px - 1)), 176, -1)
            cv2.line(canvas, (0, beam), (width_px - 1, beam), 215, 1)
            cv2.line(canvas, (0, beam + 12), (width_px - 1, beam + 12), 90, 1)
        for left in (0, width_px - post):
            cv2.rectangle(canvas, (left, 0), (left + post - 1, height_px - 1), 96, -1)
            cv2.line(canvas, (left, 0), (left, height_px), 140, 1)
            for y in range(8, height_px, 21):
                cv2.rectangle(canvas, (left + post // 3, y), (left + 2 * post // 3, y + 8), 28, -1)
        return canvas

    def _load(
        self,
        canvas: Image,
        load: np.random.Generator,
        own: np.random.Generator,
        shelf: tuple[int, int, int, int],
    ) -> None:
        """Cartons side by side on a board: (left, right, bottom, room above) in px."""
        x, right, bottom, room = shelf
        for _ in range(COLUMNS):
            design, gap, empty = int(load.integers(DESIGNS)), int(load.integers(2, 14)), load.random() < 0.06
            replacement, swapped = int(own.integers(DESIGNS + 1)), self.changed and own.random() < CHANGED
            if swapped:
                design, empty = replacement % DESIGNS, replacement == DESIGNS
            picture = carton_face(self.common, design)
            high, wide = picture.shape
            count = int(load.integers(1, max(1, room // high) + 1))
            if x + gap + wide > right:
                continue  # a narrower one may fit
            for number in range(0 if empty else count):
                top = bottom - (number + 1) * high
                if top >= bottom - room:
                    canvas[top : top + high, x + gap : x + gap + wide] = picture
            x += gap + wide


def carton(rng: np.random.Generator, width_px: int, height_px: int, common: int) -> Image:
    """The side of a stack of cartons, all of one of the warehouse's designs."""
    canvas = np.full((height_px, width_px), 60, np.uint8)
    picture = carton_face(common, int(rng.integers(DESIGNS)))
    columns = max(1, round(width_px / picture.shape[1]))
    rows = max(1, round(height_px / picture.shape[0]))
    xs = np.linspace(0, width_px, columns + 1).astype(int)
    ys = np.linspace(0, height_px, rows + 1).astype(int)
    for left, right in itertools.pairwise(xs.tolist()):
        for top, bottom in itertools.pairwise(ys.tolist()):
            size = (right - left - 1, bottom - top - 1)
            if min(size) > 2:
                face = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
                canvas[top : bottom - 1, left : right - 1] = face
    return canvas


@functools.lru_cache(maxsize=64)
def carton_face(common: int, design: int) -> Image:
    """One side of a carton of a design: brown board, tape, a brand, handling marks, a label."""
    rng = np.random.default_rng([common, 0xCA57, design])
    width_px, height_px = int(rng.integers(70, 140)), int(rng.integers(56, 115))
    board = float(rng.uniform(120, 185))
    grain = clouds(rng, width_px, height_px, 1.4)
    canvas: Image = np.clip(board + 5 * grain, 0, 255).astype(np.uint8)
    cv2.rectangle(canvas, (0, 0), (width_px - 1, height_px - 1), int(board * 0.6), 1)
    tape = int(rng.uniform(0.3, 0.7) * width_px)
    cv2.rectangle(canvas, (tape - 7, 0), (tape + 7, height_px // 5), int(min(board + 35, 250)), -1)
    ink = int(rng.integers(15, 60))
    brand = "".join(rng.choice(list("AEIOUKLMNRSTVX"), int(rng.integers(3, 7))))
    write(canvas, brand, (8, height_px // 5, width_px - 8, height_px // 5 + height_px // 4), ink)
    half = width_px // 2
    low = height_px // 2
    label = (text_page, geometric_art)[int(rng.integers(2))](rng, half - 8, height_px - low - 8)
    canvas[low : low + label.shape[0], 6 : 6 + label.shape[1]] = label
    marks = sign(rng, half - 10, (height_px - low) // 2, "")
    canvas[low + 4 : low + 4 + marks.shape[0], half + 4 : half + 4 + marks.shape[1]] = marks
    canvas.setflags(write=False)  # all racks share it
    return canvas
