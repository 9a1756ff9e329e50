"""Viewpoints: which places are covered, and where to make the next full turn."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.occupancy_grid import DistanceField, OccupancyGrid
from mapweave.agent.settings import ExplorerSettings
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2

VIEW_RADIUS = 1.6
"""What lies around a place, and what others know around theirs, is judged within this radius, m."""


DIRECTIONS = 36
"""Directions of a circle in which coverage is tested."""


GRAIN = 0.4
"""One place is tried in each square of this side, m."""


def views_of(hybrid_map: HybridMap, map_from_node: Mapping[NodeId, Pose2] | None = None) -> Array:
    """(N, 4) [x m, y m, heading rad, horizontal semi-aperture rad], in map: the nodes' fields of view.

    Args:
        hybrid_map: the nodes.
        map_from_node: where some of them lie, if not where the robot's own way says.
    """
    elsewhere = map_from_node or {}
    views = [
        (*elsewhere.get(node.id, node.map_from_robot.mean).vector, node.camera.semi_aperture)
        for node in hybrid_map.nodes.values()
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


VIEW = 3.0
"""A full turn shows floor up to this far, m."""
SCAN_TIME = 60.0
"""How long a full turn takes, about, s."""
LEAST_AREA = 1.0
"""New floor that is worth a full turn, m^2."""
NEAR = 1.4
"""Floor within this of a node, with nothing between, was seen from near, m."""
LEAST_PATCH = 0.25
"""Known floor that is worth a full turn if no node saw it from near, m^2."""
SPACING = 1.7
"""Places are at least this far from each other, m."""
REACH = 7.0
"""Farther places are looked for only if none within this way is worth a full turn, m."""


def next_viewpoint(
    floor: OccupancyGrid,
    position: Array,
    visited: Array,
    nodes: Array,
    covered_by_others: Array,
    settings: ExplorerSettings,
    spacing: float = SPACING,
) -> list[Array]:
    """Corners of the way to the place where the robot should make its next full turn; empty if there is none.

    First where most new floor is seen for the time that it takes, then where most floor is seen that no node
    saw from near. What others have covered is left to them, as long as there is anything else. Far places
    come last, but no floor with any of these is explored.

    Args:
        floor: what the rangers saw.
        position: (2,) m, in map, of the robot.
        visited: (N, 2) m, in map, N > 0: where there is nothing more to be seen.
        nodes: (K, 2) m, in map: where the robot's own nodes are.
        covered_by_others: (M, 2) m, in map: places that others have covered.
        settings: of the exploration.
        spacing: least distance of the next place from these, m.
    """
    others = (covered_by_others, covered_by_others[:0]) if len(covered_by_others) else (covered_by_others,)
    near = min(spacing, NEAR)
    for reach in (REACH, math.inf):
        ways = floor.ways(position, reach)
        for new in (True, False):
            for left_to_them in others:
                tried = _one_in_each_square(ways, np.concatenate([visited, left_to_them]), spacing)
                points = ways.positions[tried]
                if new:
                    areas = floor.unknown_in_sight(points, left_to_them, VIEW_RADIUS, VIEW)
                else:
                    areas = floor.distant_in_sight(points, np.concatenate([nodes, left_to_them]), near)
                rates = areas / (SCAN_TIME + ways.lengths[tried] / settings.travel_speed)
                rates[areas < (LEAST_AREA if new else LEAST_PATCH)] = 0.0
                if rates.any():
                    return ways.path(ways.cells[tried[rates.argmax()]])
    return []


def _one_in_each_square(ways: DistanceField, taken: Array, spacing: float) -> NDArray[np.intp]:
    """Indices of cells of `ways`, one a square, that are at least the spacing (m) from (N, 2) m in map."""
    away, positions = np.ones(len(ways.cells), np.bool_), ways.positions
    # One after the other: the whole floor has many cells.
    for place in taken:
        away &= np.linalg.norm(positions - place, axis=1) >= spacing
    free = np.flatnonzero(away)
    squares = np.floor(positions[free] / GRAIN).astype(np.int64)
    _, representatives = np.unique(squares, axis=0, return_index=True)
    return free[representatives]
