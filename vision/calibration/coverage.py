"""What the views cover, and what to show next: four bars, as ROS' camera_calibration has them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.pose import Array
from mapweave.vision.calibration.views import BoardView

NAMES = ("x", "y", "size", "skew")
RANGES = np.array([0.7, 0.7, 0.4, 0.5])
"""Range of each placement that a good set covers, as in ROS' camera_calibration."""
DIFFERENT = 0.2
"""A view counts as new when its placement differs by this much in all from that of each other view."""
FEWEST_VIEWS = 10
"""Views that differ, below which guidance asks for more."""
GRID = (3, 3)
"""Columns and rows of cells of the image in which there must be corners."""
FEWEST_IN_CELL = 4
"""Corners in a cell below which guidance asks for more there."""
PLACES = (
    ("upper left corner", "upper edge", "upper right corner"),
    ("left edge", "middle", "right edge"),
    ("lower left corner", "lower edge", "lower right corner"),
)


@dataclass(frozen=True, eq=False)
class ViewCoverage:
    """How well a set of views covers the image.

    Attributes:
        views: how many.
        bars: (4,) shares from 0 to 1 of the ranges of x, y, size and skew.
        missing: what to do next, most important first; empty if nothing is missing.
    """

    views: int
    bars: Array
    missing: tuple[str, ...]


def coverage_of(views: Sequence[BoardView]) -> ViewCoverage:
    """Compute the bars, and what is missing."""
    if not views:
        return ViewCoverage(0, np.zeros(4), ("show the board to the camera, flat and whole",))
    placements = np.array([view.placement for view in views])
    low, high = placements.min(axis=0), placements.max(axis=0)
    # The board is seen from the front and from afar in any case: size and skew begin at 0.
    low[2:] = 0.0
    bars = np.clip((high - low) / RANGES, 0.0, 1.0)
    missing: list[str] = []
    if bars[0] < 1.0:
        missing.append(f"hold the board nearer to the {'left' if low[0] > 1.0 - high[0] else 'right'} edge")
    if bars[1] < 1.0:
        missing.append(f"hold the board nearer to the {'upper' if low[1] > 1.0 - high[1] else 'lower'} edge")
    if bars[2] < 1.0:
        missing.append("hold the board nearer to the camera, until it takes half the width of the image")
    if bars[3] < 1.0:
        missing.append("tilt the board: turn one edge away from the camera, by 30 to 45 degrees")
    width, height = views[0].image_size
    pixels = np.concatenate([view.pixels for view in views])
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=(GRID[1], GRID[0]), range=((0, height), (0, width))
    )
    for row, column in np.argwhere(counts < FEWEST_IN_CELL).tolist():
        missing.append(f"show the board in the {PLACES[row][column]} of the image: no view has it there")
    if not missing and len(views) < FEWEST_VIEWS:
        missing.append(f"show {FEWEST_VIEWS - len(views)} more views that differ: other places, other tilts")
    return ViewCoverage(len(views), bars, tuple(missing))


def is_new(view: BoardView, views: Sequence[BoardView]) -> bool:
    """Whether a view's placement differs from that of all others."""
    return all(np.abs(view.placement - other.placement).sum() > DIFFERENT for other in views)


def diverse(views: Sequence[BoardView], most: int) -> list[BoardView]:
    """At most so many of the views, each as different as possible from those before, in their own order."""
    if len(views) <= most:
        return list(views)
    placements = np.array([view.placement for view in views]) / RANGES
    chosen = [int(np.argmax([len(view.points) for view in views]))]
    apart = np.linalg.norm(placements - placements[chosen[0]], axis=1)
    while len(chosen) < most:
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(placements - placements[chosen[-1]], axis=1))
    return [views[k] for k in sorted(chosen)]
