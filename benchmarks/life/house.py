"""A house of two rooms of random landmarks: the stage of the benchmark of a map's life."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.hybridmap.query import View
from synthetic.world import World, room, take_view

ROOMS = ((0.0, 0.0, 5.0, 4.0), (5.2, 0.0, 5.0, 4.0))
"""x, y, width, depth, m; their common wall has a door that hides nothing and shows nothing."""
LANDMARKS = 900
"""A room."""
WALL = 0.6
"""m that the robot keeps to the walls."""
LOOKS = 6
"""Views at a stop, all around."""
THING = 40
"""Landmarks of one piece of furniture."""


@dataclass(frozen=True, eq=False)
class TwoRooms(World):
    """Both rooms of the house; a robot sees only the one in which it stands.

    Attributes:
        rooms: (N,) which room each landmark is in.
    """

    rooms: NDArray[np.int64]

    @staticmethod
    def built(rng: np.random.Generator) -> TwoRooms:
        """The house with furniture where it is at first."""
        both = [room(*place, LANDMARKS, rng) for place in ROOMS]
        whole = both[0] + both[1]
        return TwoRooms(whole.points, whole.normals, whole.vectors, np.repeat([0, 1], LANDMARKS))

    def visible(
        self, world_from_robot: Pose2, camera: Camera, reach: float
    ) -> tuple[NDArray[np.int64], Array]:
        """See World; of one room."""
        seen, in_robot = super().visible(world_from_robot, camera, reach)
        here = int(world_from_robot.x > ROOMS[1][0])
        return seen[self.rooms[seen] == here], in_robot

    def refurnished(self, share: float, rng: np.random.Generator) -> TwoRooms:
        """Things are gone, and others have come elsewhere in the room: neighbouring landmarks go together.

        Args:
            share: of the landmarks that are replaced.
            rng: says which, and where the new ones are.
        """
        points, normals, vectors = self.points.copy(), self.normals.copy(), self.vectors.copy()
        for number, place in enumerate(ROOMS):
            here = np.flatnonzero(self.rooms == number)
            new = room(*place, len(here), rng)
            for _ in range(round(share * len(here) / THING)):
                gone = here[_nearest(points[here], points[rng.choice(here)])]
                come = _nearest(new.points, new.points[rng.integers(len(here))])
                points[gone], normals[gone], vectors[gone] = (
                    new.points[come], new.normals[come], new.vectors[come],
                )  # fmt: skip
        return replace(self, points=points, normals=normals, vectors=vectors)

    def tour(self, stops: int, rng: np.random.Generator) -> list[Pose2]:
        """A drive through both rooms, one after the other: stops anywhere in them, views all around at each.

        Args:
            stops: in a room; the next is always the nearest that is left.
            rng: draws them.
        """
        poses = []
        for place in ROOMS if rng.random() < 0.5 else ROOMS[::-1]:
            left = [anywhere(place, rng) for _ in range(stops)]
            at = (5.1, 2.0)
            while left:
                at = min(left, key=lambda stop: math.dist(stop, at))
                left.remove(at)
                begin = rng.uniform(-math.pi, math.pi)
                poses += [Pose2(*at, begin + math.tau * k / LOOKS) for k in range(LOOKS)]
        return poses

    def look(self, rng: np.random.Generator) -> tuple[View, Pose2]:
        """A view from anywhere, and from where."""
        place = ROOMS[int(rng.integers(len(ROOMS)))]
        here = Pose2(*anywhere(place, rng), rng.uniform(-math.pi, math.pi))
        return take_view(self, here, rng)[0], here


def anywhere(place: tuple[float, float, float, float], rng: np.random.Generator) -> tuple[float, float]:
    """A place on the floor of a room, away from its walls."""
    x, y, width, depth = place
    spot = rng.uniform([x + WALL, y + WALL], [x + width - WALL, y + depth - WALL])
    return float(spot[0]), float(spot[1])


def _nearest(points: Array, middle: Array) -> NDArray[np.intp]:
    """The landmarks of one thing."""
    return np.argsort(np.linalg.norm(points - middle, axis=1), kind="stable")[:THING]
