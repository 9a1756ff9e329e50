"""Places: which was looked around at already, and where to look around next."""

from __future__ import annotations

import math

import numpy as np

from agent.floor import Floor
from hybridmap.hybrid_map import HybridMap
from hybridmap.pose import Array

DIRECTIONS = 36
"""In how many directions of a circle it is asked whether a node looks there."""


def views_of(hybrid_map: HybridMap) -> Array:
    """(N, 4) [x m, y m, heading rad, horizontal semi-aperture rad], in map: where the nodes look."""
    views = [
        (*node.map_from_robot.mean.vector, node.camera.semi_aperture) for node in hybrid_map.nodes.values()
    ]
    return np.array(views, dtype=np.float64).reshape(-1, 4)


def seen_around(views: Array, position: Array, reach: float) -> float:
    """Share of the directions around a position into which some view nearby looks.

    Args:
        views: (N, 4) [x m, y m, heading rad, semi-aperture rad], in map.
        position: (2,) m, in map.
        reach: views within this are nearby, m.
    """
    near = views[np.hypot(views[:, 0] - position[0], views[:, 1] - position[1]) <= reach]
    directions = np.arange(DIRECTIONS) * math.tau / DIRECTIONS
    off = np.abs(np.angle(np.exp(1j * (directions[:, None] - near[:, 2]))))
    return float((off <= near[:, 3]).any(axis=1).mean())


def next_place(
    floor: Floor, position: Array, been: Array, others: Array, reach: float, sight: float, spacing: float
) -> list[Array]:
    """Corners of the way to the place from which most floor is still to be seen; empty if there is none.

    Args:
        floor: what the rangers saw.
        position: (2,) m, in map, of the robot.
        been: (N, 2) m, in map, N > 0: where there is nothing more to be seen.
        others: (M, 2) m, in map: where others have looked around.
        reach: the longest way, m.
        sight: what can be seen from a place is judged within this radius, m.
        spacing: the next place is at least this far from where the robot or others have been, m.
    """
    ways = floor.ways(position, reach)
    if not len(ways.cells):
        return []
    taken = np.concatenate([been, others])
    away = np.linalg.norm(ways.positions[:, None] - taken[None], axis=2).min(axis=1)
    unknown = floor.unknown_around(sight, others)[ways.cells[:, 0], ways.cells[:, 1]]
    worth = unknown - 0.04 * ways.lengths
    worth[(away < spacing) | (unknown < 0.02)] = -math.inf
    if not np.isfinite(worth).any():
        return []
    return ways.path(ways.cells[int(worth.argmax())])
