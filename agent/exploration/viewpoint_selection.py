"""Places: which was looked around at already, and where to look around next."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.occupancy_grid import DistanceField, OccupancyGrid
from mapweave.agent.settings import ExplorerSettings
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.pose import Array

SIGHT = 1.6
"""What lies around a place, and what others know around theirs, is judged within this radius, m."""


DIRECTIONS = 36
"""In how many directions of a circle it is asked whether a node looks there."""


GRAIN = 0.4
"""One place is tried in each square of this side, m."""


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


SPACING = 1.7
"""Places are at least this far from each other, m."""
REACH = 7.0
"""The longest way to a next place, m."""


def next_viewpoint(
    floor: OccupancyGrid, position: Array, been: Array, others: Array, settings: ExplorerSettings
) -> list[Array]:
    """Corners of the way to the place where the robot should look around next; empty if there is none.

    First where most new floor is seen for the time that it takes, then where it was seen from afar only. What
    others have looked around at is left to them, as long as there is anything else.

    Args:
        floor: what the rangers saw.
        position: (2,) m, in map, of the robot.
        been: (N, 2) m, in map, N > 0: where there is nothing more to be seen.
        others: (M, 2) m, in map: where others have looked around.
        settings: of the exploration.
    """
    ways = floor.ways(position, REACH)
    for choose in (_new_floor, _closer_look):
        for told in (others, others[:0]) if len(others) else (others,):
            taken = np.concatenate([been, told])
            away = np.linalg.norm(ways.positions[:, None] - taken[None], axis=2).min(axis=1)
            free = np.flatnonzero(away >= SPACING)
            path = choose(floor, ways, free, told, settings) if len(free) else []
            if path:
                return path
    return []


VIEW = 3.0
"""A look around shows floor up to this far, m."""
LOOK_TIME = 60.0
"""How long a look around takes, about, s."""
LEAST_AREA = 1.0
"""New floor that is worth a look around, m^2."""


def _new_floor(
    floor: OccupancyGrid, ways: DistanceField, free: NDArray[np.intp], told: Array, settings: ExplorerSettings
) -> list[Array]:
    """The way to where most unknown floor comes into sight per second of the way and of the look around.

    Args:
        floor: what the rangers saw.
        ways: to everything within reach.
        free: indices of the cells of `ways` that may be chosen.
        told: (M, 2) m, in map: places of others.
        settings: of the exploration.
    """
    squares = np.floor(ways.positions[free] / GRAIN).astype(np.int64)
    _, one_each = np.unique(squares, axis=0, return_index=True)
    tried = free[one_each]
    areas = floor.unknown_in_sight(ways.positions[tried], told, SIGHT, VIEW)
    rates = areas / (LOOK_TIME + ways.lengths[tried] / settings.travel_speed)
    rates[areas < LEAST_AREA] = -math.inf
    best = int(rates.argmax())
    return ways.path(ways.cells[tried[best]]) if np.isfinite(rates[best]) else []


def _closer_look(
    floor: OccupancyGrid, ways: DistanceField, free: NDArray[np.intp], told: Array, settings: ExplorerSettings
) -> list[Array]:
    """The way to where most around is unknown, in sight or not; the arguments are those of `_new_floor`."""
    unknown = floor.unknown_around(SIGHT, told)[ways.cells[free, 0], ways.cells[free, 1]]
    worth = unknown - 0.04 * ways.lengths[free]
    worth[unknown < 0.02] = -math.inf
    best = int(worth.argmax())
    return ways.path(ways.cells[free[best]]) if np.isfinite(worth[best]) else []
