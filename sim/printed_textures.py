"""Printed matter: what hangs on walls and is stuck on furniture. Each picture is unlike every other."""

import cv2
import numpy as np

from mapweave.sim.image_noise import clouds, noise
from mapweave.sim.texture import Image

FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
)
LETTERS = np.array(list("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789&?%#"))


def text_page(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """A notice: a headline and lines of words, on light or dark paper."""
    dark_paper = rng.random() < 0.3
    paper, ink = (int(rng.integers(25, 70)), 235) if dark_paper else (int(rng.integers(205, 250)), 25)
    page = np.full((height_px, width_px), paper, np.uint8)
    margin = max(4, width_px // 14)
    y = margin
    while y < height_px - margin:
        line_px = int(rng.choice([12, 16, 24, 40], p=[0.3, 0.3, 0.25, 0.15]))
        font, scale = int(rng.choice(FONTS)), line_px / 30
        x = margin + int(rng.integers(0, 3)) * line_px // 2
        y += line_px
        while x < width_px - margin and y < height_px:
            word = "".join(rng.choice(LETTERS, int(rng.integers(2, 8))))
            cv2.putText(page, word, (x, y), font, scale, ink, max(1, line_px // 10), cv2.LINE_AA)
            x += int((len(word) * 0.65 + 0.8) * line_px)
            if rng.random() < 0.12:
                break
        y += int(line_px * rng.uniform(0.3, 0.9))
    return page


def photograph(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """A photo-like picture: shaded things of all sizes in front of one another, with grain."""
    picture = 127 + 70 * clouds(rng, width_px, height_px, float(rng.uniform(1.6, 2.4)))
    canvas = np.clip(picture, 0, 255).astype(np.uint8)
    things = int(rng.integers(25, 60))
    sizes = np.sort(rng.uniform(0.015, 0.22, things))[::-1] * min(width_px, height_px)
    for size in sizes:
        centre = (int(rng.integers(0, width_px)), int(rng.integers(0, height_px)))
        axes = (max(2, int(size * rng.uniform(0.5, 1.6))), max(2, int(size)))
        grey = int(rng.integers(10, 246))
        cv2.ellipse(canvas, centre, axes, float(rng.uniform(0, 180)), 0, 360, grey, -1, cv2.LINE_AA)
        if rng.random() < 0.5:
            spot = (centre[0] - axes[0] // 4, centre[1] - axes[1] // 4)
            cv2.circle(canvas, spot, max(1, axes[1] // 3), (grey + 110) % 256, -1, cv2.LINE_AA)
    shaded = canvas + 26 * clouds(rng, width_px, height_px, 1.5)
    return np.asarray(np.clip(shaded, 0, 255), np.uint8)


def geometric_art(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Triangles, bars, rings and dots in flat greys."""
    canvas = np.full((height_px, width_px), int(rng.integers(40, 220)), np.uint8)
    side = min(width_px, height_px)
    for size in np.sort(rng.uniform(0.04, 0.5, int(rng.integers(20, 45))))[::-1] * side:
        centre = rng.uniform([0, 0], [width_px, height_px])
        grey = int(rng.choice([rng.integers(0, 90), rng.integers(150, 256)]))
        kind = rng.integers(3)
        if kind == 0:
            corners = centre + rng.uniform(-size, size, (int(rng.integers(3, 5)), 2))
            hull = cv2.convexHull(corners.astype(np.int32))
            cv2.fillConvexPoly(canvas, hull, grey, cv2.LINE_AA)
        elif kind == 1:
            end = centre + rng.uniform(-size, size, 2)
            ends = [(int(p[0]), int(p[1])) for p in (centre, end)]
            cv2.line(canvas, ends[0], ends[1], grey, max(2, int(size / 8)), cv2.LINE_AA)
        else:
            thickness = -1 if rng.random() < 0.5 else max(2, int(size / 8))
            where = (int(centre[0]), int(centre[1]))
            cv2.circle(canvas, where, max(3, int(size / 3)), grey, thickness, cv2.LINE_AA)
    return canvas


def mosaic(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """A pin board: small pictures and notes in an irregular grid."""
    canvas = np.clip(150 + 12 * noise(rng, width_px, height_px, 2.0), 0, 255).astype(np.uint8)
    columns = max(1, width_px // int(rng.integers(55, 110)))
    rows = max(1, height_px // int(rng.integers(55, 110)))
    step_x, step_y = width_px / columns, height_px / rows
    for row in range(rows):
        for column in range(columns):
            w = int(step_x * rng.uniform(0.6, 0.96))
            h = int(step_y * rng.uniform(0.6, 0.96))
            x = int(column * step_x + rng.uniform(0, step_x - w))
            y = int(row * step_y + rng.uniform(0, step_y - h))
            if w > 12 and h > 12:
                painter = (text_page, photograph, geometric_art)[int(rng.integers(3))]
                canvas[y : y + h, x : x + w] = painter(rng, w, h)
    return canvas


def diagram(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """A map or plan: regions of different greys with outlines and names."""
    count = int(rng.integers(18, 40))
    sites = rng.uniform([0, 0], [width_px, height_px], (count, 2))
    ys, xs = np.mgrid[0:height_px:4, 0:width_px:4]
    nearest = ((xs[..., None] - sites[:, 0]) ** 2 + (ys[..., None] - sites[:, 1]) ** 2).argmin(axis=-1)
    greys = rng.integers(60, 250, count).astype(np.uint8)
    canvas = cv2.resize(greys[nearest], (width_px, height_px), interpolation=cv2.INTER_NEAREST)
    canvas = np.asarray(cv2.medianBlur(canvas, 7), np.uint8)
    for x, y in sites.astype(int):
        name = "".join(rng.choice(LETTERS, int(rng.integers(2, 6))))
        scale = float(rng.choice([0.35, 0.5, 0.8]))
        cv2.putText(canvas, name, (int(x) - 12, int(y)), int(rng.choice(FONTS)), scale, 15, 1, cv2.LINE_AA)
        cv2.circle(canvas, (int(x), int(y) + 8), int(rng.integers(2, 7)), 10, -1, cv2.LINE_AA)
    return canvas


PRINTS = (text_page, photograph, geometric_art, mosaic, diagram)


def framed_print(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """Any of the prints, sometimes with a frame."""
    picture = PRINTS[int(rng.integers(len(PRINTS)))](rng, width_px, height_px)
    if rng.random() < 0.5:
        edge = max(2, min(width_px, height_px) // 40)
        cv2.rectangle(picture, (0, 0), (width_px - 1, height_px - 1), int(rng.integers(0, 90)), edge)
    return picture
