"""Names in a picture where they fit: none covers another one, a mark, or the edge of the picture."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CELL = 2.0
"""Side of the cells in which it is remembered what is covered, px."""
GAP = 2.0
"""Between a mark and its name, px."""
MARK = 2.5
"""Radius of the mark of a point, in points of 1/72 inch."""


@dataclass(frozen=True)
class Name:
    """What is written beside a point.

    Attributes:
        text: the name.
        x: of the point, m.
        y: of the point, m.
        colour: of the letters.
        size: of the letters, points.
        must: it may cover marks, but no other name, if it does not fit otherwise.
    """

    text: str
    x: float
    y: float
    colour: str
    size: float
    must: bool = False


def plain_text(figure: Any) -> None:
    """Draw all text of a figure as it is: matplotlib reads what stands between two $ as a formula."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)


def draw_names(axes: Any, names: Sequence[Name], marks: NDArray[np.float64]) -> None:
    """Write names where they fit, the first ones first; the layout of the figure must be settled.

    Args:
        axes: of matplotlib.
        names: what to write.
        marks: (N, 2) m, points that stay free, as of nodes and along edges.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.patheffects import withStroke

    window, renderer = axes.get_window_extent(), axes.figure.canvas.get_renderer()
    radius = MARK * axes.figure.dpi / 72.0
    placement = NamePlacement(window.width, window.height)
    corner = np.array([window.x0, window.y0])
    if len(marks):
        placement.cover(axes.transData.transform(marks) - corner, radius)
    for name in names:
        x, y = axes.transData.transform((name.x, name.y)) - corner
        font = FontProperties(size=name.size, weight="bold" if name.must else "normal")
        width, height, descent = renderer.get_text_width_height_descent(name.text, font, False)
        place = placement.place(x, y, width, height, radius, name.must)
        if place is None:
            continue
        at = axes.transData.inverted().transform(corner + place + (0.0, descent))
        axes.text(
            *at, name.text, color=name.colour, fontproperties=font, ha="left", va="baseline", zorder=8,
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )  # fmt: skip


class NamePlacement:
    """Finds free room, in pixels from the lower left corner of the picture."""

    def __init__(self, width: float, height: float) -> None:
        """Begin with an empty picture of a size in px."""
        self._width, self._height = width, height
        self._marks, self._names = np.zeros((2, int(height / CELL) + 1, int(width / CELL) + 1), np.bool_)

    def cover(self, points: NDArray[np.float64], radius: float) -> None:
        """Marks which names must not cover.

        Args:
            points: (N, 2) px.
            radius: of each, px.
        """
        reach = int(np.ceil(radius / CELL))
        offsets = np.arange(-reach, reach + 1)
        for down in offsets:
            for right in offsets:
                columns, rows = np.floor(points / CELL + (right, down)).astype(int).T
                inside = (rows >= 0) & (rows < self._marks.shape[0])
                inside &= (columns >= 0) & (columns < self._marks.shape[1])
                self._marks[rows[inside], columns[inside]] = True

    def place(
        self, x: float, y: float, width: float, height: float, radius: float, must: bool = False
    ) -> tuple[float, float] | None:
        """Room for a name beside a mark.

        Args:
            x: of the mark, px.
            y: of the mark, px.
            width: of the name, px.
            height: of the name, px.
            radius: of the mark, px.
            must: it may cover marks if there is no other room.

        Returns:
            The lower left corner of the name, px, which is taken now; None if it does not fit.
        """
        for covered in (self._marks | self._names, self._names)[: 1 + must]:
            for left, bottom in _corners(x, y, width, height, radius):
                if left < 0 or bottom < 0 or left + width > self._width or bottom + height > self._height:
                    continue
                cells = np.s_[
                    int(bottom / CELL) : int((bottom + height) / CELL) + 1,
                    int(left / CELL) : int((left + width) / CELL) + 1,
                ]
                if not covered[cells].any():
                    self._names[cells] = True
                    return left, bottom
        return None


def _corners(x: float, y: float, width: float, height: float, radius: float) -> Iterator[tuple[float, float]]:
    """Lower left corners of a name around a mark, best first."""
    away = radius + GAP
    right, left, above, below = x + away, x - away - width, y + away, y - away - height
    middle_x, middle_y = x - width / 2, y - height / 2
    yield from ((right, middle_y), (left, middle_y), (middle_x, above), (middle_x, below))
    yield from ((right, above), (left, above), (right, below), (left, below))
