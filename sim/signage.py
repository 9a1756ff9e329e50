"""Signs, and doors with numbers."""

import cv2
import numpy as np

from mapweave.sim.image_noise import noise
from mapweave.sim.printed_textures import LETTERS, text_page
from mapweave.sim.texture import Image

CAPITALS = np.array(list("ABCDEFGHJKLMNPQRSTUVWXYZ"))
DIGITS = np.array(list("0123456789"))


def sign(rng: np.random.Generator, width_px: int, height_px: int, text: str) -> Image:
    """A plate with large letters, an arrow or a pictogram, and small print.

    Args:
        rng: random numbers.
        width_px: across.
        height_px: down.
        text: on it; empty for random letters and numbers.
    """
    text = text or "".join([*rng.choice(CAPITALS, 1), *rng.choice(DIGITS, int(rng.integers(2, 4)))])
    dark = rng.random() < 0.5
    paper, ink = (int(rng.integers(30, 70)), 240) if dark else (int(rng.integers(215, 250)), 20)
    plate = np.full((height_px, width_px), paper, np.uint8)
    edge = max(1, min(width_px, height_px) // 30)
    cv2.rectangle(plate, (edge, edge), (width_px - 1 - edge, height_px - 1 - edge), ink, edge)
    half = int(height_px * rng.uniform(0.5, 0.62))
    write(plate, text, (3 * edge, 3 * edge, width_px - 3 * edge, half), ink)
    below = (3 * edge, half + edge, width_px - 3 * edge, height_px - 3 * edge)
    symbol = min(below[3] - below[1], (below[2] - below[0]) // 2)
    if symbol > 8:
        _pictogram(rng, plate, (below[0], below[1], symbol), ink)
        left = below[0] + symbol + edge
        if below[2] - left > 24 and symbol > 24:
            note = text_page(rng, below[2] - left, symbol)
            plate[below[1] : below[1] + symbol, left : below[2]] = note
    return plate


def door(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """A closed door in its frame, with a handle, a number on it and sometimes a notice or a window."""
    leaf = float(rng.integers(90, 200))
    surface = leaf + 5 * noise(rng, width_px, height_px, 5.0)
    canvas = np.asarray(np.clip(surface, 0, 255), np.uint8)
    frame = max(2, width_px // 16)
    cv2.rectangle(canvas, (0, 0), (width_px - 1, height_px + frame), int(rng.integers(40, 80)), frame)
    hinge = frame if rng.random() < 0.5 else width_px - 1 - frame
    cv2.line(canvas, (hinge, frame), (hinge, height_px), 20, 2)
    handle_x = width_px - 2 * frame - 8 if hinge < width_px // 2 else 2 * frame + 8
    handle_y = int(0.5 * height_px)
    towards = -1 if hinge < width_px // 2 else 1
    cv2.rectangle(canvas, (handle_x - 5, handle_y - 22), (handle_x + 5, handle_y + 30), 215, -1)
    cv2.line(canvas, (handle_x, handle_y), (handle_x + towards * 32, handle_y), 235, 6, cv2.LINE_AA)
    cv2.circle(canvas, (handle_x, handle_y + 20), 3, 15, -1, cv2.LINE_AA)
    kick = height_px - int(0.13 * height_px)
    cv2.rectangle(canvas, (2 * frame, kick), (width_px - 2 * frame, height_px - 6), int(leaf * 0.75), -1)
    inner = width_px - 6 * frame
    plate = int(0.11 * height_px)
    if inner > 30 and plate > 16:
        top = int(0.2 * height_px)
        canvas[top : top + plate, 3 * frame : 3 * frame + inner] = sign(rng, inner, plate, "")
        if rng.random() < 0.6:
            low = int(rng.uniform(0.36, 0.45) * height_px)
            high, wide = int(0.17 * height_px), int(inner * rng.uniform(0.45, 0.7))
            left = 3 * frame + int(rng.uniform(0, inner - wide))
            canvas[low : low + high, left : left + wide] = text_page(rng, wide, high)
        low = int(rng.uniform(0.62, 0.7) * height_px)
        high, wide = int(0.13 * height_px), int(inner * rng.uniform(0.35, 0.6))
        left = 3 * frame + int(rng.uniform(0, inner - wide))
        canvas[low : low + high, left : left + wide] = sign(rng, wide, high, "")
    return canvas


def write(canvas: Image, text: str, box: tuple[int, int, int, int], ink: int) -> None:
    """One line of text as large as a box (left, top, right, bottom) in px allows."""
    font = cv2.FONT_HERSHEY_DUPLEX
    (wide, high), _ = cv2.getTextSize(text, font, 1.0, 2)
    room_x, room_y = box[2] - box[0], box[3] - box[1]
    scale = min(room_x / max(wide, 1), room_y / max(high, 1)) * 0.9
    if scale <= 0.1:
        return
    x = box[0] + int((room_x - wide * scale) / 2)
    y = box[1] + int((room_y + high * scale) / 2)
    cv2.putText(canvas, text, (x, y), font, scale, ink, max(1, round(2 * scale)), cv2.LINE_AA)


def _pictogram(rng: np.random.Generator, plate: Image, square: tuple[int, int, int], ink: int) -> None:
    """An arrow, a warning triangle, or a block code, in a square (left, top, side) in px."""
    left, top, side = square
    kind = int(rng.integers(3))
    if kind == 0:
        arrow = np.array([[0, 3], [5, 3], [5, 0], [10, 5], [5, 10], [5, 7], [0, 7]]) / 10.0
        quarter = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), int(rng.integers(4)))
        corners = ((arrow - 0.5) @ quarter.T + 0.5) * side + [left, top]
        cv2.fillPoly(plate, [corners.astype(np.int32)], ink, cv2.LINE_AA)
    elif kind == 1:
        corners = np.array([[0.5, 0.0], [1.0, 1.0], [0.0, 1.0]]) * (side - 1) + [left, top]
        cv2.polylines(plate, [corners.astype(np.int32)], True, ink, max(2, side // 10), cv2.LINE_AA)
        letter = str(rng.choice(LETTERS))
        third = side // 3
        write(plate, letter, (left + third, top + third, left + 2 * third, top + side - side // 8), ink)
    else:
        cells = int(rng.integers(6, 10))
        code = rng.integers(0, 2, (cells, cells)).astype(np.uint8) * 255
        plate[top : top + side, left : left + side] = cv2.resize(
            code, (side, side), interpolation=cv2.INTER_NEAREST
        )
