"""Which floor a fleet's nodes show, and since when: by the truth, for scoring alone."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.evaluation.map_score import crossed
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan

SQUARE = 0.2
"""Side of a square of floor, m."""
CLEARANCE = 0.2
"""Floor counts where a robot can stand with this much room around its middle, m."""
REACH = 3.0
"""A node shows floor that is at most this far away, m: about as far as landmarks of rooms are placed well."""


@dataclass(frozen=True)
class Look:
    """One node, by the truth.

    Attributes:
        at: simulated time of its image, s.
        world_from_robot: true pose then.
        semi_aperture: half the horizontal field of view, rad.
    """

    at: float
    world_from_robot: Pose2
    semi_aperture: float


@dataclass(frozen=True, eq=False)
class MappedFloor:
    """When each square of a building was first seen by a node of each robot.

    Attributes:
        seen: (N, R) s, a row for each square, a column for each robot; infinite where it never was.
    """

    seen: Array

    @property
    def whole(self) -> float:
        """Floor of the building where robots can be, m^2."""
        return len(self.seen) * SQUARE**2

    def area(self, until: float) -> float:
        """Floor that any robot's nodes show by a time (s), m^2."""
        return float((self.seen.min(axis=1) <= until).sum()) * SQUARE**2

    def overlap(self, until: float) -> float:
        """Share of that floor which nodes of more than one robot show."""
        robots = (self.seen <= until).sum(axis=1)
        return float((robots > 1).sum() / max((robots > 0).sum(), 1))

    def time_to(self, share: float) -> float | None:
        """When this share of the whole floor was mapped, s; None if it never was."""
        needed = math.ceil(share * len(self.seen))
        at = float(np.sort(self.seen.min(axis=1))[needed - 1])
        return at if math.isfinite(at) else None


def mapped_floor(plan: BuildingPlan, looks: Mapping[str, Sequence[Look]]) -> MappedFloor:
    """Which floor the nodes show: in their field of view, within reach, with no wall or furniture between.

    Args:
        plan: of the building.
        looks: of each robot.
    """
    squares = floor_squares(plan)
    seen = np.full((len(squares), len(looks)), np.inf)
    for column, ones in enumerate(looks.values()):
        for look in ones:
            shown = shows(look, squares, plan)
            seen[shown, column] = np.minimum(seen[shown, column], look.at)
    return MappedFloor(seen)


def floor_squares(plan: BuildingPlan) -> Array:
    """(N, 2) m, in world: one point in each square of floor where a robot can stand."""
    points = np.concatenate([np.zeros((0, 2)), *plan.free_regions(CLEARANCE)])
    _, first = np.unique(np.floor(points / SQUARE).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[first])


def shows(look: Look, points: Array, plan: BuildingPlan) -> NDArray[np.bool_]:
    """Which of (N, 2) points (m, in world) a node shows."""
    pose = look.world_from_robot
    ahead = pose.inverse().apply(points)
    near = np.hypot(ahead[:, 0], ahead[:, 1]) <= REACH
    shown = near & (np.abs(np.arctan2(ahead[:, 1], ahead[:, 0])) <= look.semi_aperture)
    tried = np.flatnonzero(shown)
    here = np.tile([pose.x, pose.y], (len(tried), 1))
    shown[tried] = ~crossed(here, points[tried], (*plan.walls, *plan.furniture))
    return np.asarray(shown)
