"""The printed target: a chessboard, or a ChArUco board, of which a view may show a part."""

import math
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array

DICTIONARIES = {
    name.removeprefix("DICT_"): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith(("DICT_4X4", "DICT_5X5", "DICT_6X6"))
}
"""OpenCV's dictionaries of markers by name."""
BORDER = 1
"""Black cells around the bits of a marker."""


class Pattern(StrEnum):
    """Kinds of targets."""

    CHARUCO = "charuco"
    CHESSBOARD = "chessboard"


class TargetRectangle(NamedTuple):
    """A black rectangle of the target, m: x right, y down from its upper left corner.

    Attributes:
        x: of the left edge.
        y: of the upper edge.
        width: to the right.
        height: downwards.
    """

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class CalibrationTarget:
    """A board of squares; the upper left one is black. Markers are in the white squares.

    Attributes:
        pattern: chessboard or ChArUco.
        columns: squares across.
        rows: squares down.
        square: side of a square, m.
        marker: side of a marker, m.
        dictionary: of the markers.
    """

    pattern: Pattern = Pattern.CHARUCO
    columns: int = 7
    rows: int = 10
    square: float = 0.024
    marker: float = 0.018
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        """Refuse what cannot be printed or found.

        Raises:
            InvalidValue: a number is out of range, or a chessboard looks the same upside down.
        """
        if not (3 <= self.columns <= 40 and 3 <= self.rows <= 40):
            raise InvalidValue(f"target: {self.columns}x{self.rows} squares; 3x3 to 40x40 are possible")
        if not (math.isfinite(self.square) and 0.002 <= self.square <= 1.0):
            raise InvalidValue(f"target: squares of {1e3 * self.square:g} mm; 2 to 1000 mm are possible")
        if self.pattern is Pattern.CHESSBOARD:
            if (self.columns + self.rows) % 2 == 0:
                raise InvalidValue(
                    f"target: a chessboard of {self.columns}x{self.rows} squares looks the same upside down; "
                    "one number must be odd and the other even"
                )
            return
        if not 0.3 * self.square <= self.marker <= 0.95 * self.square:
            raise InvalidValue(
                f"target: markers of {1e3 * self.marker:g} mm in squares of {1e3 * self.square:g} mm; they "
                "must be 0.3 to 0.95 of a square"
            )
        if self.dictionary not in DICTIONARIES:
            raise InvalidValue(
                f"target: no dictionary {self.dictionary!r}; there are {', '.join(DICTIONARIES)}"
            )
        most = len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary]).bytesList)
        if self.columns * self.rows // 2 > most:
            raise InvalidValue(f"target: {self.dictionary} has {most} markers, too few for this board")

    def __str__(self) -> str:
        """The target for people."""
        text = f"{self.pattern} {self.columns}x{self.rows}, squares {1e3 * self.square:g} mm"
        if self.pattern is Pattern.CHESSBOARD:
            return text
        return f"{text}, markers {1e3 * self.marker:g} mm, dictionary {self.dictionary}"

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, m."""
        return self.columns * self.square, self.rows * self.square

    @cached_property
    def corners(self) -> Array:
        """(N, 3) m, inner corners of the squares, row by row; z is 0."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float64)

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board of the same numbers."""
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)

    def rectangles(self) -> list[TargetRectangle]:
        """All that is black."""
        s = self.square
        black = [
            TargetRectangle(column * s, row * s, s, s)
            for row in range(self.rows)
            for column in range(self.columns)
            if (row + column) % 2 == 0
        ]
        if self.pattern is Pattern.CHARUCO:
            white = [(c, r) for r in range(self.rows) for c in range(self.columns) if (r + c) % 2]
            margin = (s - self.marker) / 2
            for number, (column, row) in enumerate(white):
                cells = self._cells(number)
                cell = self.marker / len(cells)
                x, y = column * s + margin, row * s + margin
                black += [
                    TargetRectangle(x + first * cell, y + k * cell, (last - first) * cell, cell)
                    for k, line in enumerate(cells)
                    for first, last in _runs(line)
                ]
        return black

    def _cells(self, number: int) -> NDArray[np.bool_]:
        """(K, K) which cells of a marker are black."""
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])
        side = dictionary.markerSize + 2 * BORDER
        return np.asarray(cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=BORDER) == 0)


def _runs(line: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and end of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
