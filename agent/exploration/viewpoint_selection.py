"""Viewpoints: which places are covered, and where to make the next full turn."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.occupancy_grid import DistanceField, OccupancyGrid
from mapweave.agent.settings import ExplorerSettings
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.pose import Array

VIEW_RADIUS = 1.6
"""What lies around a place, and what others know around theirs, is judged within this radius, m."""


DIRECTIONS = 36
"""Directions of a circle in which coverage is tested."""


GRAIN = 0.4
"""One place is tried in each square of this side, m."""


def views_of(hybrid_map: HybridMap) -> Array:
    """(N, 4) [x m, y m, heading rad, horizontal semi-aperture rad], in map: the nodes' fields of view."""
    views = [
        (*node.map_from_robot.mean.vector, node.camera.semi_aperture) for node in hybrid_map.nodes.values()
    ]
    return np.array(views, dtype=np.float64).reshape(-1, 4)


def seen_around(views: Array, position: Array, reach: float) -> float:
    """Share of the directions around a position that some nearby view covers.

    Args:
        views: (N, 4) [x m, y m, heading rad, semi-aperture rad], in map.
        position: (2,) m, in map.
        reach: views within this are nearby, m.
    """
    nearby = views[np.hypot(views[:, 0] - position[0], views[:, 1] - position[1]) <= reach]
    directions = np.arange(DIRECTIONS) * math.tau / DIRECTIONS
    off = np.abs(np.angle(np.exp(1j * (directions[:, None] - nearby[:, 2]))))
    return float((off <= nearby[:, 3]).any(axis=1).mean())


SPACING = 1.7
"""Places are at least this far from each other, m."""
REACH = 7.0
"""The longest way to a next place, m."""


def next_viewpoint(
    floor: OccupancyGrid,
    position: Array,
    visited: Array,
    covered_by_others: Array,
    settings: ExplorerSettings,
    spacing: float = SPACING,
) -> list[Array]:
    """Corners of the way to the place where the robot should make its next full turn; empty if there is none.

    First where most new floor is seen for the time that it takes, then where floor was seen only from afar.
    What others have covered is left to them, as long as there is anything else.

    Args:
        floor: what the rangers saw.
        position: (2,) m, in map, of the robot.
        visited: (N, 2) m, in map, N > 0: where there is nothing more to be seen.
        covered_by_others: (M, 2) m, in map: places that others have covered.
        settings: of the exploration.
        spacing: least distance of the next place from these, m.
    """
    ways = floor.ways(position, REACH)
    for choose in (_new_area, _closer_view):
        for skipped in (
            (covered_by_others, covered_by_others[:0]) if len(covered_by_others) else (covered_by_others,)
        ):
            taken = np.concatenate([visited, skipped])
            away = np.linalg.norm(ways.positions[:, None] - taken[None], axis=2).min(axis=1)
            free = np.flatnonzero(away >= spacing)
            path = choose(floor, ways, free, skipped, settings) if len(free) else []
            if path:
                return path
    return []


VIEW = 3.0
"""A full turn shows floor up to this far, m."""
SCAN_TIME = 60.0
"""How long a full turn takes, about, s."""
LEAST_AREA = 1.0
"""New floor that is worth a full turn, m^2."""


def _new_area(
    floor: OccupancyGrid,
    ways: DistanceField,
    free: NDArray[np.intp],
    covered: Array,
    settings: ExplorerSettings,
) -> list[Array]:
    """The way to where most unknown floor becomes visible per second of the way and of the full turn.

    Args:
        floor: what the rangers saw.
        ways: to everything within reach.
        free: indices of the cells of `ways` that may be chosen.
        covered: (M, 2) m, in map: places that others have covered.
        settings: of the exploration.
    """
    squares = np.floor(ways.positions[free] / GRAIN).astype(np.int64)
    _, representatives = np.unique(squares, axis=0, return_index=True)
    tried = free[representatives]
    areas = floor.unknown_in_sight(ways.positions[tried], covered, VIEW_RADIUS, VIEW)
    rates = areas / (SCAN_TIME + ways.lengths[tried] / settings.travel_speed)
    rates[areas < LEAST_AREA] = -math.inf
    best = int(rates.argmax())
    return ways.path(ways.cells[tried[best]]) if np.isfinite(rates[best]) else []


def _closer_view(
    floor: OccupancyGrid,
    ways: DistanceField,
    free: NDArray[np.intp],
    covered: Array,
    settings: ExplorerSettings,
) -> list[Array]:
    """The way to where most around is unknown, visible or not; the arguments are those of `_new_area`."""
    unknown = floor.unknown_around(VIEW_RADIUS, covered)[ways.cells[free, 0], ways.cells[free, 1]]
    worth = unknown - 0.04 * ways.lengths[free]
    worth[unknown < 0.02] = -math.inf
    best = int(worth.argmax())
    return ways.path(ways.cells[free[best]]) if np.isfinite(worth[best]) else []
