"""The camera's image with what the calibration needs next, for a page."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.vision.calibration.collection import Guidance
from mapweave.vision.calibration.coverage import NAMES
from mapweave.vision.calibration.views import BoardView

WIDTH = 800
"""px of the picture."""
BAR = (150, 14)
"""Width and height of a bar, px."""
GREEN, GREY, WHITE, BLUE, DARK = (80, 190, 80), (150, 150, 150), (255, 255, 255), (230, 150, 60), (35, 35, 35)
"""Blue, green, red."""
FONT = cv2.FONT_HERSHEY_SIMPLEX


def guidance_picture(
    image: NDArray[np.uint8], guidance: Guidance, views: Sequence[BoardView]
) -> NDArray[np.uint8]:
    """Draw.

    Args:
        image: (H, W) grey.
        guidance: of this image.
        views: so far; their corners show which part of the image is covered.

    Returns:
        (H', 800, 3) blue, green, red: the image with corners, below it hint and bars.
    """
    scale = WIDTH / image.shape[1]
    height = round(scale * image.shape[0])
    seen = cv2.cvtColor(cv2.resize(image, (WIDTH, height)), cv2.COLOR_GRAY2BGR)
    for view in views:
        _dots(seen, view, scale, BLUE, 2)
    if guidance.view is not None:
        _dots(seen, guidance.view, scale, GREEN if guidance.taken else WHITE, 4)
    below = np.full((110, WIDTH, 3), DARK, np.uint8)
    hint = guidance.hint[:1].upper() + guidance.hint[1:]
    size = min(0.65, 0.65 * (WIDTH - 20) / max(cv2.getTextSize(hint, FONT, 0.65, 1)[0][0], 1))
    cv2.putText(below, hint, (10, 30), FONT, size, WHITE, 1, cv2.LINE_AA)
    for k, (name, share) in enumerate(zip(NAMES, guidance.coverage.bars.tolist(), strict=True)):
        x, y = 10 + k * (BAR[0] + 35), 80
        cv2.putText(below, name, (x, y - 8), FONT, 0.5, WHITE, 1, cv2.LINE_AA)
        cv2.rectangle(below, (x, y), (x + BAR[0], y + BAR[1]), GREY, 1)
        cv2.rectangle(below, (x, y), (x + round(BAR[0] * share), y + BAR[1]), GREEN, -1)
    cv2.putText(below, f"{guidance.coverage.views}", (WIDTH - 45, 92), FONT, 0.6, WHITE, 1, cv2.LINE_AA)
    cv2.putText(below, "views", (WIDTH - 50, 72), FONT, 0.5, WHITE, 1, cv2.LINE_AA)
    return np.asarray(np.concatenate([seen, below]), np.uint8)


def _dots(
    picture: NDArray[Any], view: BoardView, scale: float, colour: tuple[int, int, int], radius: int
) -> None:
    for x, y in np.rint(scale * (view.pixels + 0.5)).astype(int).tolist():
        cv2.circle(picture, (x, y), radius, colour, -1, cv2.LINE_AA)
