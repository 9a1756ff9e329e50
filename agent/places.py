"""Places: which was looked around at already, and where to look around next."""

from __future__ import annotations

import math

import numpy as np

from agent.floor import Floor
from hybridmap.hybrid_map import HybridMap
from hybridmap.pose import Array

DIRECTIONS = 36
"""In how many directions of a circle it is asked whether a node looks there."""


def seen_around(hybrid_map: HybridMap, position: Array, reach: float) -> float:
    """Share of the directions around a position into which some node nearby looks.

    Args:
        hybrid_map: the own map.
        position: (2,) m, in map.
        reach: nodes within this are nearby, m.
    """
    near = [
        node
        for node in hybrid_map.nodes.values()
        if math.hypot(node.map_from_robot.mean.x - position[0], node.map_from_robot.mean.y - position[1])
        <= reach
    ]
    if not near:
        return 0.0
    headings = np.array([node.map_from_robot.mean.heading for node in near])
    half = np.array([node.camera.semi_aperture for node in near])
    directions = np.arange(DIRECTIONS) * math.tau / DIRECTIONS
    off = np.abs(np.angle(np.exp(1j * (directions[:, None] - headings))))
    return float((off <= half).any(axis=1).mean())


def next_place(
    floor: Floor, position: Array, been: Array, reach: float, sight: float, spacing: float
) -> list[Array]:
    """Corners of the way to the place from which most floor is still to be seen; empty if there is none.

    Args:
        floor: what the rangers saw.
        position: (2,) m, in map, of the robot.
        been: (N, 2) m, in map, N > 0: where there is nothing more to be seen.
        reach: the longest way, m.
        sight: what can be seen from a place is judged within this radius, m.
        spacing: the next place is at least this far from where the robot has been, m.
    """
    ways = floor.ways(position, reach)
    if not len(ways.cells):
        return []
    away = np.linalg.norm(ways.positions[:, None] - been[None], axis=2).min(axis=1)
    unknown = floor.unknown_around(sight)[ways.cells[:, 0], ways.cells[:, 1]]
    worth = unknown - 0.04 * ways.lengths
    worth[(away < spacing) | (unknown < 0.02)] = -math.inf
    if not np.isfinite(worth).any():
        return []
    return ways.path(ways.cells[int(worth.argmax())])
