"""Where robots start: spread over the rooms, clear of walls and of one another."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan, largest_part, random_pose

APART = 0.65
"""Middles of two robots are never closer, m: 45 cm and a robot's radius, and what the grid rounds away."""
COMFORT = 1.0
"""Nor closer than this where there is place, m."""
TRIES = 30
"""Random places that are tried for one robot."""


def spread(
    plan: BuildingPlan, rooms: Sequence[str], robots: int, clearance: float, look_along: bool, seed: int
) -> tuple[Pose2, ...]:
    """Free poses, robot i in room i (counted around) as long as there is place.

    Args:
        plan: the building.
        rooms: names of those in which robots start.
        robots: how many.
        clearance: of a robot's middle from walls and furniture, m.
        look_along: whether robots face along the longer side of their room, else anywhere.
        seed: other seeds, other poses.

    Raises:
        InvalidValue: so many do not fit.
    """
    rng = np.random.default_rng([seed, 0x57A27])
    regions = plan.free_regions(clearance)
    free = [largest_part(regions, plan.room(room)) for room in rooms]
    poses: list[Pose2] = []
    for robot in range(robots):
        number = robot % len(rooms)
        pose = _apart(rng, free[number], poses, look_along)
        if pose is None:
            pose = _apart(rng, np.concatenate(free), poses, look_along)
        if pose is None:
            return _packed(plan, rooms, free, robots, clearance, look_along, rng)
        poses.append(_along(plan, pose, rng) if look_along else pose)
    return tuple(poses)


def _apart(rng: np.random.Generator, points: Array, taken: Sequence[Pose2], spread_out: bool) -> Pose2 | None:
    """A random pose on one of the points, apart from those taken; the farthest of a few if so wished."""
    if len(points) == 0:
        return None
    tries = [random_pose(rng, points) for _ in range(TRIES)]
    gaps = [min((p.distance(q) for q in taken), default=math.inf) for p in tries]
    comfortable = [p for p, gap in zip(tries, gaps, strict=True) if gap > COMFORT]
    if comfortable and not spread_out:
        return comfortable[0]
    best = int(np.argmax(gaps))
    if gaps[best] >= APART:
        return tries[best]
    positions = np.array([[p.x, p.y] for p in taken])
    distances = np.linalg.norm(points[:, None] - positions, axis=-1).min(axis=1)
    if distances.max() < APART:
        return None
    x, y = points[int(np.argmax(distances))]
    return replace(tries[best], x=float(x), y=float(y))


def _packed(
    plan: BuildingPlan,
    rooms: Sequence[str],
    free: Sequence[Array],
    robots: int,
    clearance: float,
    look_along: bool,
    rng: np.random.Generator,
) -> tuple[Pose2, ...]:
    """As many places as fit when the floor is filled row by row, robot i in room i as long as it lasts."""
    places: list[list[Array]] = []
    taken: list[Array] = []
    for points in free:
        places.append(_rows(points, taken))
        taken += places[-1]
    if len(taken) < robots:
        raise InvalidValue(
            f"only {len(taken)} robots fit with {clearance} m around each, not {robots}: "
            "make the world larger or with more rooms, or start fewer robots"
        )
    poses = []
    for robot in range(robots):
        number = robot % len(rooms)
        if not places[number]:
            number = max(range(len(rooms)), key=lambda k: len(places[k]))
        x, y = places[number].pop(int(rng.integers(len(places[number]))))
        pose = Pose2(float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
        poses.append(_along(plan, pose, rng) if look_along else pose)
    return tuple(poses)


def _rows(points: Array, taken: Sequence[NDArray[np.float64]]) -> list[Array]:
    """Places at least `APART` from one another and from those taken, each the next free one of its row."""
    left = points[np.lexsort((points[:, 0], points[:, 1]))]
    for place in taken:
        left = left[np.linalg.norm(left - place, axis=1) >= APART]
    places = []
    while len(left):
        places.append(left[0])
        left = left[np.linalg.norm(left - left[0], axis=1) >= APART]
    return places


def _along(plan: BuildingPlan, pose: Pose2, rng: np.random.Generator) -> Pose2:
    """The same place, with a heading along the longer side of the room there, either way."""
    room = plan.room(plan.room_at(pose.x, pose.y) or "")
    heading = room.heading + (0.0 if room.length >= room.width else math.pi / 2)
    return replace(pose, heading=heading + math.pi * int(rng.integers(2)) + float(rng.uniform(-0.15, 0.15)))
