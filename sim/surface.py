"""Painters of whole surfaces: walls, furniture, floors. `mapweave.sim.worlds.light` shines on them."""

import itertools

import cv2
import numpy as np

from mapweave.sim.image_noise import Field, clouds, noise
from mapweave.sim.printed_textures import LETTERS, framed_print
from mapweave.sim.texture import Image

TEXELS_PER_METRE = 280
"""Resolution of walls and furniture: what a 320 px, 60 degree camera resolves at 1 m."""


def plaster(rng: np.random.Generator, width_px: int, height_px: int, paint: float) -> Image:
    """Painted plaster with faint grain, few marks, now and then a socket, and a skirting board."""
    canvas = _plaster(rng, width_px, height_px, paint)
    for _ in range(int(rng.poisson(width_px * height_px / 160_000))):
        x, y = int(rng.integers(width_px)), int(rng.integers(height_px))
        reach = rng.normal(0.0, 14.0, 2)
        end = (x + int(reach[0]), y + int(reach[1]))
        cv2.line(canvas, (x, y), end, int(canvas[y, x]) - int(rng.integers(8, 30)), 1, cv2.LINE_AA)
    if width_px > 60 and rng.random() < 0.25:
        _socket(canvas, int(rng.uniform(20, width_px - 40)), height_px - int(0.33 * TEXELS_PER_METRE))
    return _skirted(rng, canvas)


def wall(rng: np.random.Generator, width_px: int, height_px: int, paint: float) -> Image:
    """Painted plaster with prints at different heights, and a skirting board."""
    canvas = _plaster(rng, width_px, height_px, paint)
    metre = TEXELS_PER_METRE
    # Low prints are what a robot sees near by, high ones what it sees across the room.
    bands = ((0.12, 0.75), (0.8, 1.45), (1.5, 2.1))
    for (low, high), likely in zip(bands, (0.9, 0.85, 0.5), strict=True):
        if rng.random() > likely:
            continue
        height = int(rng.uniform(0.55, 0.95) * (high - low) * metre)
        width = min(int(height * rng.uniform(0.7, 1.8)), int(width_px * 0.92))
        top = height_px - int((low + rng.uniform(0, high - low - height / metre)) * metre) - height
        left = int(rng.uniform(0.03 * width_px, 0.97 * width_px - width))
        if top >= 0 and width > 20 and left >= 0:
            canvas[top : top + height, left : left + width] = framed_print(rng, width, height)
    return _skirted(rng, canvas)


def concrete(rng: np.random.Generator, width_px: int, height_px: int, paint: float) -> Image:
    """Cast concrete: blotches, pores, and the marks of the boards it was cast in."""
    blotches = _seamless(clouds(rng, width_px, height_px, 1.6))
    surface = 0.8 * paint + 9 * blotches + 3 * noise(rng, width_px, height_px, 2.0)
    canvas = np.asarray(np.clip(surface, 0, 255), np.uint8)
    _pores(rng, canvas, 4000)
    for y in range(height_px - int(0.5 * TEXELS_PER_METRE), 0, -int(0.5 * TEXELS_PER_METRE)):
        cv2.line(canvas, (0, y), (width_px, y), int(0.66 * paint), 1, cv2.LINE_AA)
    return canvas


def cladding(rng: np.random.Generator, width_px: int, height_px: int, paint: float) -> Image:
    """Trapezoidal sheet metal: upright, equal ribs, on a low concrete plinth, with scratches."""
    rib = np.arange(width_px) / (0.2 * TEXELS_PER_METRE) % 1.0
    shade = np.select([rib < 0.4, rib < 0.5, rib < 0.9], [1.0, 0.8, 0.93], 1.08)
    surface = paint * shade[None, :] + 4 * _seamless(clouds(rng, width_px, height_px, 1.3))
    canvas = np.asarray(np.clip(surface, 0, 255), np.uint8)
    plinth = min(int(0.25 * TEXELS_PER_METRE), height_px // 3)
    canvas[height_px - plinth :] = concrete(rng, width_px, plinth, 0.8 * paint)
    screws = np.flatnonzero(np.diff((rib < 0.2).astype(np.int8)) > 0)
    for y in range(height_px - plinth - 14, 0, -int(0.6 * TEXELS_PER_METRE)):
        for x in screws.tolist():
            cv2.circle(canvas, (x + 28, y), 3, 60, -1, cv2.LINE_AA)
            if rng.random() < 0.3:
                _streak(rng, canvas, (x + 28, y + 3))
    for _ in range(int(rng.poisson(2.5 * width_px / TEXELS_PER_METRE))):
        # What fork lifts and trolleys leave: scuffs at the height of pallets.
        x, y = int(rng.integers(width_px)), height_px - int(rng.uniform(0.02, 0.6) * TEXELS_PER_METRE)
        end = (x + int(rng.normal(0, 30)), y + int(rng.normal(0, 5)))
        grey = int(rng.choice([rng.integers(25, 70), rng.integers(200, 235)]))
        cv2.line(canvas, (x, y), end, grey, int(rng.integers(1, 5)), cv2.LINE_AA)
    if width_px > 90 and rng.random() < 0.5:
        side = int(rng.integers(30, 70))
        x, y = (
            int(rng.integers(4, width_px - side - 4)),
            height_px - plinth - int(rng.uniform(0.3, 1.0) * 200),
        )
        if y >= 0:
            canvas[y : y + side, x : x + side] = framed_print(rng, side, side)
    return canvas


def wood(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Wood with its grain along the width."""
    base = float(rng.uniform(70, 170))
    rings = noise(rng, width_px, height_px, 6.0)
    long_rings = cv2.resize(
        rings[:, : max(2, width_px // 12)], (width_px, height_px), interpolation=cv2.INTER_CUBIC
    )
    surface = base + 10 * long_rings + 4 * clouds(rng, width_px, height_px, 1.3)
    return np.asarray(np.clip(surface, 0, 255), np.uint8)


def desk(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Drawers with handles and locks next to a panel with a few notes on it."""
    canvas = wood(rng, width_px, height_px)
    base = int(canvas.mean())
    cv2.rectangle(canvas, (0, 0), (width_px - 1, max(4, height_px // 24)), int(0.7 * base), -1)
    wide = min(int(0.42 * TEXELS_PER_METRE), width_px // 2)
    left = 0 if rng.random() < 0.5 else width_px - wide
    drawers = int(rng.integers(2, 5))
    edges = np.linspace(height_px // 24 + 6, height_px - 10, drawers + 1).astype(int).tolist()
    for top, bottom in itertools.pairwise(edges):
        cv2.rectangle(canvas, (left + 4, top), (left + wide - 4, bottom - 3), int(0.55 * base), 2)
        middle = (left + wide // 2, top + (bottom - top) // 3)
        cv2.rectangle(canvas, (middle[0] - 20, middle[1] - 3), (middle[0] + 20, middle[1] + 3), 215, -1)
        cv2.circle(canvas, (left + wide - 16, top + 10), 3, 225, -1, cv2.LINE_AA)
    for _ in range(int(rng.integers(2, 6))):
        w, h = int(rng.integers(22, 70)), int(rng.integers(18, 60))
        if w < width_px - 8 and h < height_px - 20:
            x, y = int(rng.integers(4, width_px - w - 2)), int(rng.integers(12, height_px - h - 2))
            canvas[y : y + h, x : x + w] = framed_print(rng, w, h)
    return canvas


def cupboard(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Doors with knobs, labels and stickers."""
    canvas = wood(rng, width_px, height_px)
    for door in range(1, max(2, round(width_px / 130))):
        x = door * width_px // max(2, round(width_px / 130))
        cv2.line(canvas, (x, 0), (x, height_px), 25, 3)
        cv2.circle(canvas, (x - 14, height_px // 2), 6, 235, -1, cv2.LINE_AA)
    for _ in range(max(2, width_px * height_px // 9000)):
        w, h = int(rng.integers(24, 85)), int(rng.integers(20, 70))
        if w < width_px - 8 and h < height_px - 8:
            x, y = int(rng.integers(4, width_px - w - 2)), int(rng.integers(4, height_px - h - 2))
            canvas[y : y + h, x : x + w] = framed_print(rng, w, h)
    return canvas


def bookshelf(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Boards with book spines, titles on them."""
    canvas = np.clip(45 + 6 * clouds(rng, width_px, height_px, 1.3), 0, 255).astype(np.uint8)
    bottom = height_px - 8
    while bottom > 40:
        shelf = min(int(rng.integers(62, 105)), bottom - 4)
        x = 6
        while x < width_px - 10:
            width = int(rng.integers(7, 26))
            height = int(shelf * rng.uniform(0.6, 0.95))
            if rng.random() < 0.06:
                x += int(rng.integers(8, 40))
                continue
            right = min(x + width, width_px - 5)
            grey = int(rng.integers(30, 245))
            canvas[bottom - height : bottom, x:right] = grey
            ink = 20 if grey > 125 else 235
            for _ in range(int(rng.integers(1, 4))):
                y = bottom - int(rng.uniform(0.1, 0.9) * height)
                cv2.rectangle(canvas, (x + 2, y), (right - 3, y + int(rng.integers(1, 8))), ink, -1)
            if width > 16:
                letter = str(rng.choice(LETTERS))
                where = (x + 3, bottom - height // 2)
                cv2.putText(canvas, letter, where, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, 1, cv2.LINE_AA)
            x = right + 1
        cv2.rectangle(canvas, (0, bottom), (width_px - 1, bottom + 5), 150, -1)
        bottom -= shelf + 8
    return canvas


def crate(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """A carton with large prints."""
    canvas = np.clip(150 + 8 * clouds(rng, width_px, height_px, 1.3), 0, 255).astype(np.uint8)
    edge_x, edge_y = width_px // 12, height_px // 12
    if width_px > 40 and height_px > 40:
        inner = framed_print(rng, width_px - 2 * edge_x, height_px - 2 * edge_y)
        canvas[edge_y : edge_y + inner.shape[0], edge_x : edge_x + inner.shape[1]] = inner
    return canvas


def linoleum(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Almost plain, with flecks that only a near camera sees: what it sees there is worth little."""
    soft = _seamless(clouds(rng, width_px, height_px, 2.0), down=True)
    surface = 122 + 4 * soft + 2.5 * noise(rng, width_px, height_px, 2.0)
    return np.clip(surface, 0, 255).astype(np.uint8)


def screed(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """The floor of a hall: concrete with stains, tyre marks and cracks."""
    blotches = _seamless(clouds(rng, width_px, height_px, 1.7), down=True)
    canvas = np.clip(128 + 7 * blotches, 0, 255).astype(np.uint8)
    _pores(rng, canvas, 8000)
    area = width_px * height_px / TEXELS_PER_METRE**2
    for _ in range(int(rng.poisson(0.25 * area))):
        centre = (int(rng.integers(width_px)), int(rng.integers(height_px)))
        axes = (int(rng.uniform(6, 45)), int(rng.uniform(6, 30)))
        stain = np.zeros_like(canvas)
        cv2.ellipse(stain, centre, axes, float(rng.uniform(0, 180)), 0, 360, 28, -1, cv2.LINE_AA)
        canvas = cv2.subtract(canvas, cv2.blur(stain, (15, 15))).astype(np.uint8)
    for _ in range(int(rng.poisson(0.12 * area))):
        steps = rng.normal(0.0, 12.0, (14, 2)) + rng.normal(0.0, 14.0, 2)
        crack = rng.uniform([0, 0], [width_px, height_px]) + np.cumsum(steps, axis=0)
        cv2.polylines(canvas, [crack.astype(np.int32)], False, 70, 1, cv2.LINE_AA)
    return canvas


def tiles(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Square tiles of 30 cm with joints; each a little lighter or darker."""
    side = 0.3 * TEXELS_PER_METRE
    columns, rows = int(width_px / side) + 1, int(height_px / side) + 1
    shades = rng.normal(0.0, 5.0, (rows, columns))
    row, column = (np.arange(n) / side for n in (height_px, width_px))
    surface = (
        135 + shades[np.ix_(row.astype(int), column.astype(int))] + 3 * clouds(rng, width_px, height_px, 1.5)
    )
    joint = (column % 1.0 < 0.016)[None, :] | (row % 1.0 < 0.016)[:, None]
    return np.asarray(np.clip(np.where(joint, 95, surface), 0, 255), np.uint8)


def _plaster(rng: np.random.Generator, width_px: int, height_px: int, paint: float) -> Image:
    grain = _seamless(clouds(rng, width_px, height_px, 1.3))
    fine = noise(rng, width_px, height_px, 2.0)
    return np.asarray(np.clip(paint + 6 * grain + 1.5 * fine, 0, 255), np.uint8)


def _seamless(grain: Field, down: bool = False) -> Field:
    """Grain that fades out where the next length of wall or floor begins, which has grain of its own."""
    for axis in (1, 0) if down else (1,):
        size = grain.shape[axis]
        edge = np.minimum(np.arange(size), np.arange(size)[::-1]) + 0.5
        ramp = np.minimum(edge / (0.15 * TEXELS_PER_METRE), 1.0).astype(np.float32)
        grain = grain * (ramp[None, :] if axis else ramp[:, None])
    return grain


def _skirted(rng: np.random.Generator, canvas: Image) -> Image:
    """The surface with a skirting board, the same along every wall, scuffed."""
    board = int(0.06 * TEXELS_PER_METRE)
    if len(canvas) > 4 * board:
        scuffs = noise(rng, canvas.shape[1], board, 3.0)
        canvas[-board:] = np.clip(78 + 5 * scuffs, 0, 255).astype(np.uint8)
        canvas[-board - 1] = 50
    return canvas


def _streak(rng: np.random.Generator, canvas: Image, start: tuple[int, int]) -> None:
    """Rust that has run down."""
    x, top = start
    for y in range(top, min(top + int(rng.integers(20, 110)), len(canvas) - 1)):
        canvas[y, max(0, x - 1) : x + 1] = np.clip(canvas[y, max(0, x - 1) : x + 1] * 0.8, 0, 255)


def _socket(canvas: Image, x: int, y: int) -> None:
    """A wall socket, always the same, 8 cm wide."""
    side = int(0.08 * TEXELS_PER_METRE)
    if y < 0:
        return
    cv2.rectangle(canvas, (x, y), (x + side, y + side), 236, -1)
    cv2.rectangle(canvas, (x, y), (x + side, y + side), 120, 1)
    centre = (x + side // 2, y + side // 2)
    cv2.circle(canvas, centre, side // 3, 205, -1, cv2.LINE_AA)
    for hole in (-3, 3):
        cv2.circle(canvas, (centre[0] + hole, centre[1]), 1, 30, -1, cv2.LINE_AA)


def _pores(rng: np.random.Generator, canvas: Image, texels: int) -> None:
    """Dark dots, one in so many texels."""
    height_px, width_px = canvas.shape
    count = width_px * height_px // texels
    places = rng.integers(0, [width_px, height_px], (count, 2))
    for (x, y), size, grey in zip(
        places.tolist(),
        rng.integers(1, 3, count).tolist(),
        rng.integers(60, 110, count).tolist(),
        strict=True,
    ):
        cv2.circle(canvas, (x, y), size, grey, -1, cv2.LINE_AA)
