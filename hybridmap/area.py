"""Areas: polygons in the frame of a node, so that they move with the map when it is merged again."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.limits import Coordinate
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Array

LEAST_CORNERS, MOST_CORNERS = 3, 64
FARTHEST = 1e4
"""Of a corner from its anchor, m."""


@dataclass(frozen=True, slots=True)
class Area:
    """A piece of floor.

    Attributes:
        anchor: the node in whose frame the corners are.
        corners: of a polygon, in order, m. Where it crosses itself the even-odd rule says what is inside.
    """

    anchor: NodeId
    corners: tuple[tuple[Coordinate, Coordinate], ...]

    def __post_init__(self) -> None:
        """Refuse what encloses nothing.

        Raises:
            InvalidValue: too few or too many corners, one that is far away, or all on one line.
        """
        if not LEAST_CORNERS <= len(self.corners) <= MOST_CORNERS:
            raise InvalidValue(
                f"an area has {LEAST_CORNERS} to {MOST_CORNERS} corners, not {len(self.corners)}"
            )
        if not all(math.isfinite(v) and abs(v) <= FARTHEST for corner in self.corners for v in corner):
            raise InvalidValue(f"corners are at most {FARTHEST:g} m from the anchor")
        x, y = np.array(self.corners).T - np.array(self.corners[0])[:, None]
        if np.linalg.matrix_rank(np.stack([x, y]), tol=1e-6) < 2:
            raise InvalidValue("the corners of an area must not lie on one line")

    def contains(self, points_in_anchor: Array) -> NDArray[np.bool_]:
        """Which points lie inside, by the even-odd rule: a ray to the right crosses an odd number of sides.

        Args:
            points_in_anchor: (N, 2) m, in the anchor's frame.

        Returns:
            (N,) bool.
        """
        corners = np.array(self.corners)
        x, y = points_in_anchor[:, 0, None], points_in_anchor[:, 1, None]
        (x1, y1), (x2, y2) = corners.T, np.roll(corners, -1, axis=0).T
        spans = (y1 > y) != (y2 > y)
        # Left of the side, seen upwards: multiplied out, since a side may be almost level.
        left = (x - x1) * (y2 - y1) < (y - y1) * (x2 - x1)
        odd: NDArray[np.bool_] = (spans & (left == (y2 > y1))).sum(axis=1) % 2 == 1
        return odd


def read_corner(word: str) -> tuple[float, float]:
    """A corner as people write it: `1.5,-2`.

    Raises:
        InvalidValue: it is none.
    """
    try:
        x, y = map(float, word.split(","))
    except ValueError:
        raise InvalidValue(f"{word!r} is no corner: write X,Y in m, for example 1.5,-2") from None
    return x, y
