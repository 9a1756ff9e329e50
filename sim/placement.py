"""Where in a building robots start or can be put, and where a person can walk."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan
from mapweave.sim.robots import RobotSetup
from mapweave.sim.world import World

STEP = 0.04
"""Legs of a path are sampled at this distance, m."""
APART = 0.45
"""Least distance between the middles of two robots, or of a robot and a person, m."""
AHEAD = tuple(math.radians(deg) for deg in (0, 12, -12, 25, -25))
AROUND = tuple(math.radians(deg) for deg in (50, -50, 90, -90, 135, -135, 180))
"""Directions from a robot in which a person may walk past: in front of its camera if possible."""
SLANTS = (0.0, 0.9, -0.9)
"""Across what the robot sees if there is room, else obliquely, rad."""

Points = Sequence[tuple[float, float]]


def starting_places(world: World, setups: Sequence[RobotSetup], seed: int) -> tuple[Pose2, ...]:
    """One place for each robot, `world_from_robot`.

    Raises:
        InvalidValue: a setup's place is taken or no free place, or not all robots fit.
    """
    given = [setup.pose for setup in setups]
    taken: list[tuple[float, float]] = []
    for setup, pose in zip(setups, given, strict=True):
        if pose is None:
            continue
        radius = setup.describe().radius
        if not world.plan.is_free(pose.x, pose.y, radius):
            raise InvalidValue(f"robot {setup.name} cannot start at ({pose.x:g}, {pose.y:g}): no free place")
        if any(np.hypot(pose.x - x, pose.y - y) < 2 * radius for x, y in taken):
            raise InvalidValue(f"robot {setup.name} cannot start at ({pose.x:g}, {pose.y:g}): it is taken")
        taken.append((pose.x, pose.y))
    if all(pose is not None for pose in given):
        return tuple(pose for pose in given if pose is not None)
    rng = np.random.default_rng([seed, 0x57A27, 1])
    chosen = []
    for setup, pose, suggested in zip(setups, given, world.start_poses(len(setups), seed), strict=True):
        place = pose or suggested
        if pose is None and any(np.hypot(place.x - x, place.y - y) < APART for x, y in taken):
            place = somewhere(world.plan, rng, setup.describe().radius + 0.1, np.array(taken))
        if pose is None:
            taken.append((place.x, place.y))
        chosen.append(place)
    return tuple(chosen)


def put_down(plan: BuildingPlan, wanted: Pose2, radius: float, taken: NDArray[np.float64]) -> Pose2:
    """The wanted place, or the nearest free one.

    Args:
        plan: the building.
        wanted: world_from_robot.
        radius: of the robot, m.
        taken: (N, 2) m, in world, of others.

    Raises:
        InvalidValue: walls or furniture are where the robot should be, or all places near by are taken.
    """
    if not plan.is_free(wanted.x, wanted.y, radius):
        raise InvalidValue(f"({wanted.x:g}, {wanted.y:g}) is no free place on the floor of this world")
    for ring in range(12):
        angles = np.arange(max(1, 8 * ring)) * math.tau / max(1, 8 * ring)
        around = np.column_stack([np.cos(angles), np.sin(angles)])
        points = np.array([wanted.x, wanted.y]) + 0.1 * ring * around
        good = (plan.clearances(points) >= radius) & _apart(points, taken)
        if good.any():
            x, y = points[int(good.argmax())].tolist()
            return Pose2(x, y, wanted.heading)
    raise InvalidValue(f"near ({wanted.x:g}, {wanted.y:g}) all places are taken")


def somewhere(
    plan: BuildingPlan, rng: np.random.Generator, radius: float, taken: NDArray[np.float64], room: str = ""
) -> Pose2:
    """A free place in a room, or anywhere, with any heading.

    Raises:
        InvalidValue: no such room, or no such place.
    """
    for _ in range(200):
        pose = plan.random_free_pose(rng, radius, room or None)
        if _apart(np.array([[pose.x, pose.y]]), taken).all():
            return pose
    raise InvalidValue(f"all places in {room or 'this world'} are taken")


def beside(
    plan: BuildingPlan, rng: np.random.Generator, other: Pose2, radius: float, taken: NDArray[np.float64]
) -> Pose2:
    """A free place 0.6 to 2 m from another robot and visible from it, with any heading.

    Raises:
        InvalidValue: there is none.
    """
    for farthest in (2.0, 4.0):
        distances, angles = rng.uniform(0.6, farthest, 300), rng.uniform(0, math.tau, 300)
        points = [other.x, other.y] + distances[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        good = (plan.clearances(points) >= radius) & _apart(points, taken)
        for x, y in points[good].tolist():
            if is_clear(plan, [(other.x, other.y), (x, y)], 0.02):
                return Pose2(x, y, float(rng.uniform(-math.pi, math.pi)))
    raise InvalidValue(f"there is no free place near ({other.x:.2f}, {other.y:.2f})")


def is_clear(plan: BuildingPlan, path: Points, radius: float) -> bool:
    """Whether a disc gets along a path without touching a wall or furniture."""
    return bool((plan.clearances(sampled(path)) >= radius).all())


def check_path(plan: BuildingPlan, path: Points, radius: float) -> None:
    """Refuse a path on which a disc cannot go.

    Raises:
        InvalidValue: a leg leads through a wall, through furniture or out of the building, or has no length.
    """
    for (x0, y0), (x1, y1) in pairwise(path):
        leg = f"from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g})"
        if math.hypot(x1 - x0, y1 - y0) < 0.01:
            raise InvalidValue(f"walk: the leg {leg} has no length")
        if not is_clear(plan, [(x0, y0), (x1, y1)], radius):
            raise InvalidValue(f"walk: the leg {leg} leads through, or too near to, a wall or furniture")


def past(
    plan: BuildingPlan, rng: np.random.Generator, robot: Pose2, radius: float
) -> list[tuple[float, float]]:
    """A straight path across a robot's view, 1 to 2.5 m ahead; beside or behind it if there is no room.

    Args:
        plan: the building.
        rng: random numbers.
        robot: world_from_robot.
        radius: of who shall walk, m.

    Raises:
        InvalidValue: there is no room near the robot.
    """
    near, far = (1.0, 2.5), (0.8, 4.0)
    for shortest, directions, (nearest, farthest) in (
        (1.2, AHEAD, near), (0.6, AHEAD, near), (1.2, AROUND, near), (0.5, AHEAD + AROUND, far),
    ):  # fmt: skip
        for bearing in directions:
            toward = robot.heading + bearing
            for distance in rng.uniform(nearest, farthest, 6).tolist():
                middle = robot.x + distance * math.cos(toward), robot.y + distance * math.sin(toward)
                if not is_clear(plan, [(robot.x, robot.y), middle], 0.02):
                    continue
                for slant in SLANTS:
                    angle = toward + math.pi / 2 + slant + float(rng.uniform(-0.4, 0.4))
                    path = _longest(plan, middle, angle, radius)
                    if path and math.dist(path[0], path[-1]) >= shortest and _misses(path, robot):
                        return path if rng.random() < 0.5 else path[::-1]
    raise InvalidValue(f"no path near ({robot.x:.2f}, {robot.y:.2f}): there is no room")


def sampled(path: Points) -> Array:
    """(N, 2) m, points along a path, ends included."""
    pieces = []
    for (x0, y0), (x1, y1) in pairwise(path):
        count = max(2, math.ceil(math.hypot(x1 - x0, y1 - y0) / STEP) + 1)
        pieces.append(np.column_stack([np.linspace(x0, x1, count), np.linspace(y0, y1, count)]))
    return np.concatenate(pieces) if pieces else np.array(path, dtype=np.float64).reshape(-1, 2)


def _longest(
    plan: BuildingPlan, middle: tuple[float, float], angle: float, radius: float
) -> list[tuple[float, float]]:
    """Both ways from a point as far as a disc gets, at most 1.8 m; empty if it does not even fit there."""
    ends = []
    for way in (1.0, -1.0):
        reaches = np.arange(0.0, 1.8, STEP)
        direction = way * np.array([math.cos(angle), math.sin(angle)])
        points = np.array(middle) + reaches[:, None] * direction
        blocked = plan.clearances(points) < radius
        last = int(blocked.argmax()) - 1 if blocked.any() else len(points) - 1
        if last < 0:
            return []
        ends.append((float(points[last, 0]), float(points[last, 1])))
    return ends


def _misses(path: Points, robot: Pose2) -> bool:
    """Whether a path does not lead straight into a robot."""
    return bool(np.hypot(*(sampled(path) - [robot.x, robot.y]).T).min() >= 0.7)


def _apart(points: NDArray[np.float64], taken: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether points are far enough from all that are taken."""
    if not len(taken):
        return np.ones(len(points), np.bool_)
    gaps = np.linalg.norm(points[:, None] - taken[None], axis=-1)
    return np.asarray(gaps.min(axis=1) >= APART)
