"""Painters of whole surfaces: wall segments with prints on them, furniture, floors."""

from __future__ import annotations

import cv2
import numpy as np

from sim.grain import clouds, lighting, noise
from sim.print import LETTERS, framed_print
from sim.texture import Image

TEXELS_PER_METRE = 280
"""Resolution of walls and furniture: what a 320 px, 60 degree camera resolves at 1 m."""


def wall(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Plaster with grain and stains, prints at different heights, and a skirting board."""
    base = float(rng.uniform(140, 215))
    surface = base + 7 * clouds(rng, width_px, height_px, 1.3)
    surface *= lighting(rng, width_px, height_px)
    canvas = np.asarray(np.clip(surface, 0, 255), np.uint8)
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
    skirting = int(0.06 * metre)
    canvas[height_px - skirting :] = int(rng.integers(50, 110))
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


def floor(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Almost plain linoleum: what the camera sees there is worth little."""
    return np.clip(118 + 4 * clouds(rng, width_px, height_px, 2.0), 0, 255).astype(np.uint8)
