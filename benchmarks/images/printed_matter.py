"""Generated posters: lettering, rules, pictures and halftone, as stand on the walls of an office."""

import cv2
import numpy as np
from numpy.typing import NDArray

FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)
LETTERS = np.array(list("aabcdeeefghiijklmnnoopqrrssttuuvwxyzABCDEFGHKLMNPRSTW0123456789"))


def printed_page(rng: np.random.Generator, width: int = 480, height: int = 360) -> NDArray[np.uint8]:
    """One page in grey (height, width), different for each draw of the generator."""
    page = np.full((height, width), rng.uniform(170, 250))
    page += _clouds(rng, width, height, coarse=4) * 12
    for _ in range(rng.integers(2, 6)):
        _picture(page, rng)
    # OpenCV 5 letters bytes only.
    inked = np.clip(page + rng.normal(0, 2, page.shape), 0, 255).astype(np.uint8)
    for _ in range(rng.integers(3, 8)):
        _block_of_text(inked, rng)
    for _ in range(rng.integers(5, 25)):
        _shape(inked, rng)
    return inked


def _clouds(rng: np.random.Generator, width: int, height: int, coarse: int) -> NDArray[np.float64]:
    """Smooth noise of about unit amplitude at three scales."""
    out = np.zeros((height, width))
    for octave in range(3):
        cells = coarse * 3**octave
        out += cv2.resize(
            rng.normal(0, 1, (cells, cells)), (width, height), interpolation=cv2.INTER_CUBIC
        ) / (octave + 1)
    return out


def _picture(page: NDArray[np.float64], rng: np.random.Generator) -> None:
    height, width = page.shape
    w, h = rng.integers(width // 8, width // 2), rng.integers(height // 8, height // 2)
    x, y = rng.integers(0, width - w), rng.integers(0, height - h)
    page[y : y + h, x : x + w] = rng.uniform(60, 190) + 45 * _clouds(
        rng, int(w), int(h), int(rng.integers(2, 9))
    )


def _block_of_text(page: NDArray[np.uint8], rng: np.random.Generator) -> None:
    height, width = page.shape
    font, scale = FONTS[rng.integers(len(FONTS))], rng.uniform(0.3, 1.6)
    x, y, ink = int(rng.integers(0, width // 2)), int(rng.integers(15, height)), rng.uniform(0, 120)
    for line in range(rng.integers(1, 6)):
        words = ["".join(rng.choice(LETTERS, rng.integers(2, 9))) for _ in range(rng.integers(1, 6))]
        where = (x, y + int(line * 32 * scale))
        cv2.putText(page, " ".join(words), where, font, scale, ink, int(rng.integers(1, 4)), cv2.LINE_AA)


def _shape(page: NDArray[np.uint8], rng: np.random.Generator) -> None:
    height, width = page.shape
    a, b = (tuple(int(v) for v in rng.integers(0, (width, height))) for _ in range(2))
    ink, thickness = rng.uniform(0, 255), int(rng.choice([-1, 1, 2, 4]))
    match rng.integers(3):
        case 0:
            c = (min(a[0] + int(rng.integers(5, 70)), width), min(a[1] + int(rng.integers(5, 50)), height))
            cv2.rectangle(page, a, c, ink, thickness)
        case 1:
            cv2.circle(page, a, int(rng.integers(3, 35)), ink, thickness, cv2.LINE_AA)
        case _:
            cv2.line(page, a, b, ink, abs(thickness), cv2.LINE_AA)
