"""Areas: polygons in the frame of a node, so that they move with the map when it is merged again."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import Coordinate
from mapweave.hybridmap.pose import Array, Pose2

LEAST_CORNERS, MOST_CORNERS = 3, 64
"""Of an area; the second is a limit for messages."""
FARTHEST = 1e4
"""Of a corner from its anchor, m."""
ROUND = 16
"""Corners of the polygon around a circle; it reaches 2 % beyond the circle at its corners."""
SLIVER = 1e-6
"""m; what is narrower comes of rounding: a corner that touches another side may lie on either side of it."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon in the frame of a node.

    Attributes:
        anchor: the node.
        corners: (x, y) in its robot frame, in order around the polygon, m.
    """

    anchor: NodeId
    corners: tuple[tuple[Coordinate, Coordinate], ...]

    def __post_init__(self) -> None:
        """Refuse what encloses nothing.

        Raises:
            InvalidValue: too few or too many corners, one that is far away, or all on one line. An outline
                that crosses itself is not refused here, so that what was kept before can be read;
                see `check_outline`.
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

    @staticmethod
    def around(node: NodeId, radius: float) -> Area:
        """The smallest regular polygon around a circle at a node.

        Args:
            node: the centre.
            radius: m.

        Raises:
            InvalidValue: the radius is not positive, or too great.
        """
        if not 0.0 < radius < FARTHEST:
            raise InvalidValue(f"radius {radius:g}: give metres, more than 0 and less than {FARTHEST:g}")
        reach = radius / math.cos(math.pi / ROUND)
        angles = [2.0 * math.pi * k / ROUND for k in range(ROUND)]
        return Area(
            node, tuple((round(reach * math.cos(a), 4), round(reach * math.sin(a), 4)) for a in angles)
        )

    @staticmethod
    def of_merged(anchor: NodeId, merged_from_anchor: Pose2, corners: Sequence[tuple[float, float]]) -> Area:
        """An area with its corners in the merged frame of the anchor's component."""
        anchor_from_merged = merged_from_anchor.inverse()
        within = (anchor_from_merged @ Pose2(x, y) for x, y in corners)
        return Area(anchor, tuple((pose.x, pose.y) for pose in within))

    def check_outline(self) -> None:
        """Refuse an outline that crosses itself (InvalidValue)."""
        check_outline(self.corners)

    @property
    def size(self) -> float:
        """m², by the shoelace formula; a polygon that crosses itself counts its loops with their signs."""
        x, y = np.array(self.corners, dtype=float).T
        return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0)

    def contains(self, points_in_anchor: Array) -> NDArray[np.bool_]:
        """(N,) which points lie inside.

        Args:
            points_in_anchor: (N, 2) m, in the anchor's frame.
        """
        return inside(np.array(self.corners), points_in_anchor)

    def polygon(self, merged_from_anchor: Pose2) -> Floats:
        """(N, 2) the corners in the merged frame."""
        placed = (merged_from_anchor @ Pose2(x, y) for x, y in self.corners)
        return np.array([(pose.x, pose.y) for pose in placed])


def inside(polygon: Floats, points: Floats) -> NDArray[np.bool_]:
    """(N,) whether points lie in a polygon: a ray to the right crosses an odd number of sides.

    Args:
        polygon: (C, 2) corners in order.
        points: (N, 2) in the same frame.
    """
    x, y = points[:, 0, None], points[:, 1, None]
    (x1, y1), (x2, y2) = polygon.T, np.roll(polygon, -1, axis=0).T
    spans = (y1 > y) != (y2 > y)
    # Left of the side, seen upwards: multiplied out, since a side may be almost level.
    left = (x - x1) * (y2 - y1) < (y - y1) * (x2 - x1)
    odd: NDArray[np.bool_] = (spans & (left == (y2 > y1))).sum(axis=1) % 2 == 1
    return odd


def crosses(polygon: Floats, begin: Floats, end: Floats, closed: bool = True) -> NDArray[np.bool_]:
    """(N,) whether segments cross the border of a polygon, or touch it.

    Args:
        polygon: (C, 2) corners in order.
        begin: (N, 2) of the segments.
        end: (N, 2) likewise.
        closed: whether the last corner is joined with the first; if not, it is a line and no polygon.
    """
    a, b = polygon, np.roll(polygon, -1, axis=0)
    if not closed:
        a, b = a[:-1], b[:-1]
    a, b = a[:, None], b[:, None]
    # Two segments meet if the ends of each lie on different sides of the other.
    apart = _side(begin, end, a) * _side(begin, end, b)
    across = _side(a, b, begin) * _side(a, b, end)
    # All on one line: they meet if the boxes around them do.
    low, high = np.minimum(a, b), np.maximum(a, b)
    boxes = ((low <= np.maximum(begin, end)) & (high >= np.minimum(begin, end))).all(axis=-1)
    return np.asarray(((apart <= 0.0) & (across <= 0.0) & boxes).any(axis=0))


def _side(a: Floats, b: Floats, point: Floats) -> Floats:
    """Positive if a point lies to the left of the line from a to b."""
    along, to = b - a, point - a
    return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])


def check_outline(corners: Sequence[tuple[float, float]]) -> None:
    """Refuse an outline that crosses itself: what lies inside would not be what a person means.

    It may touch itself, and end with its first corner.

    Args:
        corners: (x, y) in order, m.

    Raises:
        InvalidValue: it crosses itself, and where.
    """
    # Far below a sliver: quotients of sides overflow where one is 1e-300 m long.
    outline = np.round(np.array(corners, dtype=float), 9)
    crossings = _crossings(outline)
    if not _encloses_twice(outline, crossings):
        return
    sides = [f"from corner {k + 1} to {(k + 1) % len(outline) + 1}" for pair in crossings for k in pair]
    where = f" (its side {sides[0]} and that {sides[1]})" if sides else ""
    raise InvalidValue(f"the outline of the area crosses itself{where}: give the corners in order around it")


def _crossings(outline: Floats) -> dict[tuple[int, int], float]:
    """The sides that cross each other within both, by their first corners, with the y of the crossing.

    Args:
        outline: (C, 2) corners in order.
    """
    a, b = outline, np.roll(outline, -1, axis=0)
    along = b - a
    found = {}
    for i, j in combinations(range(len(outline)), 2):
        turn = along[i, 0] * along[j, 1] - along[i, 1] * along[j, 0]
        if turn == 0.0:
            continue
        to = a[j] - a[i]
        on_first = (to[0] * along[j, 1] - to[1] * along[j, 0]) / turn
        on_second = (to[0] * along[i, 1] - to[1] * along[i, 0]) / turn
        if 0.0 < on_first < 1.0 and 0.0 < on_second < 1.0:
            found[i, j] = float(a[i, 1] + on_first * along[i, 1])
    return found


def _encloses_twice(outline: Floats, crossings: Mapping[tuple[int, int], float]) -> bool:
    """Whether an outline goes more than once around something, or around two things in opposite directions.

    That is so wherever it crosses itself, also at a corner.

    Args:
        outline: (C, 2) corners in order.
        crossings: of its sides.
    """
    begin, end = outline, np.roll(outline, -1, axis=0)
    sides = end - begin
    levels = np.unique([*outline[:, 1], *crossings.values()])
    turns = {0}
    for low, high in pairwise(levels):
        if high - low <= SLIVER:
            continue
        # Between two levels no side begins, ends or crosses another.
        y = (low + high) / 2.0
        across = (begin[:, 1] < y) != (end[:, 1] < y)
        along, up = sides[across].T
        x = begin[across, 0] + (y - begin[across, 1]) / up * along
        order = np.argsort(x)
        around = np.cumsum(np.sign(up[order]))[:-1]
        turns.update(around[np.diff(x[order]) > SLIVER].tolist())
        if max(turns) - min(turns) > 1:
            return True
    return False


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
