"""Where a fleet begins to explore: set down in one place, or each robot in a room of its own."""

from dataclasses import replace

import numpy as np

from mapweave.evaluation.map_score import crossed
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.scenario import Scenario, load_scenario, scenario_path
from mapweave.sim.floorplan import BuildingPlan, random_pose

CLEARANCE = 0.4
"""Of a robot's middle from walls and furniture, m."""
APART, NEAR = 0.9, 2.5
"""Robots stand at least and at most so far from each other and from the first, m."""
PLACES, TRIES = 20, 200
"""Places that are tried for a fleet, and poses at each."""


def office(rooms: int, robots: int, seed: int, spread: bool) -> Scenario:
    """An office that a fleet shall explore.

    Args:
        rooms: of it.
        robots: how many.
        seed: of the world and of the places.
        spread: each robot in a room of its own, as far as there are rooms; else all in one place.
    """
    scenario = load_scenario(scenario_path("office"), (f"robots={robots}", f"world.rooms={rooms}"))
    if spread:
        return scenario
    places = gathered(scenario.world(seed).plan, robots, seed)
    setups = [
        replace(setup, start=(pose.x, pose.y, pose.heading))
        for setup, pose in zip(scenario.robots, places, strict=True)
    ]
    return replace(scenario, robots=tuple(setups))


def gathered(plan: BuildingPlan, robots: int, seed: int) -> list[Pose2]:
    """Places for robots near to each other, with no wall between.

    Args:
        plan: of the building.
        robots: how many.
        seed: other seeds, other places.

    Raises:
        InvalidValue: so many do not fit into one place.
    """
    rng, points = np.random.default_rng([seed, 0x9A7E]), plan.free_points(CLEARANCE)
    for _ in range(PLACES if len(points) else 0):
        # Around some places there is no room for all.
        poses = [random_pose(rng, points)]
        for _ in range(TRIES):
            if len(poses) == robots:
                return poses
            pose = random_pose(rng, points)
            if _beside(pose, poses, plan):
                poses.append(pose)
    raise InvalidValue(f"{robots} robots do not fit into one place: use --spread")


def _beside(pose: Pose2, poses: list[Pose2], plan: BuildingPlan) -> bool:
    """Whether a place is near to the first of others, clear of all, and no wall stands between."""
    first = poses[0]
    if min(map(pose.distance, poses)) < APART or pose.distance(first) > NEAR:
        return False
    return not crossed(np.array([[pose.x, pose.y]]), np.array([[first.x, first.y]]), plan.walls)[0]
