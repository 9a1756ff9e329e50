"""How much of a building was mapped, and how long the ways were that loops have closed."""

from collections.abc import Iterable, Mapping

import numpy as np

from mapweave.evaluation.map_score import crossed, is_false
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.scenarios.recording import TrialTrajectory
from mapweave.sim.floorplan import BuildingPlan

REACH = 1.5
"""A place is explored if a node was made this near to it, with no wall between, m."""
CLEARANCE = 0.2
"""A place is a point with this much room around it for a robot, m."""
SPACING = 0.2
"""Distance between places, m."""
NEAREST = 4
"""So many of the nearest nodes are tried before a place counts as unexplored."""


def explored_share(plan: BuildingPlan, places: Array) -> float | None:
    """Share of the floor that is near a node; of closed parts of a building only those that hold nodes.

    Args:
        plan: of the building.
        places: (N, 2) m, true positions of the nodes, in world.

    Returns:
        None without free floor.
    """
    regions = plan.free_regions(CLEARANCE)
    entered = [region for region in regions if _holds(region, places)] or regions
    if not entered:
        return None
    points = np.concatenate(entered)
    # One point for each square, for any grid of the plan.
    _, first = np.unique(np.floor(points / SPACING).astype(np.int64), axis=0, return_index=True)
    points = points[first]
    near_node = np.zeros(len(points), bool)
    if len(places):
        distances = np.linalg.norm(points[:, None] - places[None], axis=2)
        order = np.argsort(distances, axis=1, kind="stable")[:, :NEAREST]
        for rank in range(order.shape[1]):
            node = order[:, rank]
            within = distances[np.arange(len(points)), node] <= REACH
            tried = np.flatnonzero(within & ~near_node)
            near_node[tried] = ~crossed(points[tried], places[node[tried]], plan.walls)
    return float(near_node.mean())


def _holds(region: Array, places: Array) -> bool:
    """Whether a node is in a region, whose points are a grid."""
    return any(np.hypot(*(region - place).T).min() < CLEARANCE for place in places)


def longest_loop(
    loops: Iterable[Edge],
    truth: Mapping[NodeId, Pose2],
    trajectories: Mapping[str, TrialTrajectory],
    stamps: Mapping[NodeId, int],
) -> float | None:
    """The longest way that a robot drove before one of its maps recognised where it had been, m.

    Args:
        loops: edges within maps, found by recognising a place; false ones do not count.
        truth: `world_from_robot` of each node.
        trajectories: true, of each robot.
        stamps: of each node, ns.

    Returns:
        None without loops.
    """
    driven = {
        name: np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(t.poses[:, :2], axis=0), axis=1))])
        for name, t in trajectories.items()
    }
    ways = []
    for loop in loops:
        if loop.a not in truth or loop.b not in truth or is_false(loop, truth):
            continue
        times = trajectories[loop.a.agent].stamps_ns
        at = np.searchsorted(times, [stamps[loop.a], stamps[loop.b]])
        start, end = driven[loop.a.agent][np.minimum(at, len(times) - 1)]
        ways.append(abs(float(end - start)))
    return max(ways, default=None)
