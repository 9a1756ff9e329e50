"""Faces of walls: where they are cut into pieces, and which of them is nearest to a point."""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import Rectangle

SEGMENT = 1.3
"""Walls are papered in pieces at most this wide, m: one filter level of a texture fits a whole piece."""
LEAST = 0.01
"""No piece is narrower than this, m."""
BEFORE = 0.05
"""A face belongs to the room of the point so far in front of it, m."""


def room_before(points: NDArray[np.float64], low: Array, high: Array) -> NDArray[np.intp]:
    """(N,) the first room in which each of (N, 2) points lies, or -1.

    Args:
        points: m, in world.
        low: (R, 2) m, south-west corners of upright rooms.
        high: (R, 2) m, north-east corners.
    """
    inside = np.all((low <= points[:, None]) & (points[:, None] <= high), axis=2)
    return np.where(np.any(inside, axis=1), np.argmax(inside, axis=1), -1)


def cut_face(start: Array, end: Array, low: Array, high: Array) -> list[tuple[Array, Array]]:
    """The pieces of a face from left to right, none before two rooms and none too wide.

    Args:
        start: (2,) m, in world, where the face begins, on the left as seen from in front of it.
        end: (2,) m, where it ends.
        low: (R, 2) m, south-west corners of rooms.
        high: (R, 2) m, north-east corners.
    """
    way = end - start
    size = float(np.linalg.norm(way))
    front = start + BEFORE * np.array([way[1], -way[0]]) / size
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        crossings = np.concatenate([(low - front) / way, (high - front) / way]).ravel()
    inner = crossings[(crossings > 0.0) & (crossings < 1.0)]
    borders = np.concatenate([[0.0], np.unique(inner), [1.0]])
    rooms = room_before(front + (borders[:-1] + borders[1:])[:, None] / 2 * way, low, high)
    cuts, current = [0.0], -1
    for border, room in zip(borders.tolist(), rooms.tolist(), strict=False):
        # Where there is no room, as before the end of another wall, a piece may be of either side.
        if room >= 0 and room != current:
            if current >= 0 and size * (border - cuts[-1]) > LEAST and size * (1.0 - border) > LEAST:
                cuts.append(border)
            current = room
    pieces = []
    for begin, stop in itertools.pairwise([*cuts, 1.0]):
        count = max(1, math.ceil(size * (stop - begin) / SEGMENT - 1e-9))
        edges = start + np.linspace(begin, stop, count + 1)[:, None] * way
        pieces += list(itertools.pairwise(edges))
    return pieces


def nearest_face(base: Rectangle, at: NDArray[np.float64]) -> tuple[Pose2, float, float]:
    """The face of a wall that is nearest to a point in front of it.

    Args:
        base: what the wall covers.
        at: (2,) m, in world.

    Returns:
        The frame in the face's middle (x outward, y to the right as seen from in front), half the face's
        width, and how far the point is from the wall, m; zero inside.
    """
    frame = Pose2(base.x, base.y, base.heading)
    x, y = frame.inverse().apply(at)
    beyond_x, beyond_y = abs(x) - base.length / 2, abs(y) - base.width / 2
    gap = math.hypot(max(beyond_x, 0.0), max(beyond_y, 0.0))
    if beyond_x > beyond_y:
        heading, reach, half = (0.0 if x > 0 else math.pi), base.length / 2, base.width / 2
    else:
        heading, reach, half = math.copysign(math.pi / 2, y), base.width / 2, base.length / 2
    return frame @ Pose2(heading=heading) @ Pose2(reach), half, gap
