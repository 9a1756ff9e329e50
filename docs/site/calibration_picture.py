"""Draws the picture of `calibrate-camera.md`: the printed target, and the guidance while it is held up.

The target is read from its own PDF and seen through a lens with barrel distortion; what is said about it is
what `mapweave calibrate camera` says.
"""

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.drawing.guidance_picture import guidance_picture
from mapweave.vision.calibration.collection import ViewCollection
from mapweave.vision.calibration.target import CalibrationTarget
from mapweave.vision.calibration.target_pdf import target_pdf
from mapweave.vision.calibration.views import BoardDetector
from tests.vision.calibration.boards import Page, bitmap, drawn_view, read_page

PATH = Path(__file__).parents[1] / "calibrate-camera.png"
SIZE = (800, 600)
"""px of the camera's image."""
LENS = np.array([700.0, 702.0, 402.0, 298.0, -0.3, 0.12, 0.001, -0.0005, -0.02])
VIEWS = (
    (-0.5, -0.25, 0.5, 0.0, 0.1),
    (0.45, -0.1, 0.45, 0.0, -0.5),
    (-0.1, 0.05, 0.35, 0.5, 0.2),
    (-0.45, 0.2, 0.5, -0.4, 0.3),
    (0.25, -0.15, 0.33, 0.2, -0.35),
)
"""Where the target is held: x and y of its middle in half images, distance m, tilts rad."""
PER_MM = 8.0
"""px of the target's drawing."""


def printed(page: Page) -> NDArray[np.uint8]:
    """The page with its scales and words, (H, W) grey."""
    image, _ = bitmap(page, PER_MM)
    for x0, y0, x1, y1 in PER_MM * page.lines:
        low = round(PER_MM * page.size[1])
        cv2.line(image, (round(x0), low - round(y0)), (round(x1), low - round(y1)), 0, 2, cv2.LINE_AA)
    left, below = round(PER_MM * page.rectangles[:, 0].min()), len(image) - 80
    words = [re.sub(r"\\(.)", r"\1", text) for text in page.texts if not text.isdigit()]
    for k, text in enumerate(words):
        at = (left, below - 50 * (len(words) - 1 - k))
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 1.1, 0, 2, cv2.LINE_AA)
    return image


def main(path: Path = PATH) -> str:
    """Draw; returns what the guidance says."""
    rng = np.random.default_rng(2)
    target = CalibrationTarget()
    page = read_page(target_pdf(target, "a4"))
    board, target_from_bitmap = bitmap(page, PER_MM)
    collection = ViewCollection(BoardDetector(target))
    for x, y, distance, *tilt in VIEWS:
        turn = np.array([*tilt, 0.1])
        rotation, _ = cv2.Rodrigues(turn)
        middle = np.array([x * SIZE[0] / 2 / LENS[0], y * SIZE[1] / 2 / LENS[1], 1.0])
        at = np.concatenate([turn, distance * middle - rotation @ [*(np.array(target.size) / 2), 0.0]])
        # A view counts when the target is still: two frames of it.
        for _ in range(2):
            image = drawn_view(board, target_from_bitmap, LENS, at, rng, SIZE, finer=1)
            guidance = collection.see(image)
    seen = guidance_picture(image, guidance, collection.views[:-1])
    paper = printed(page)
    width = round(len(seen) * paper.shape[1] / len(paper))
    small = cv2.resize(paper, (width, len(seen)), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), np.concatenate([cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), seen], axis=1))
    return guidance.hint


if __name__ == "__main__":
    main()
