"""What each robot of the fleet maps: a tour of a room of its own."""

import math
from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from synthetic.world import Sensing, room, take_map, take_view

LANDMARKS = 150
SENSING = Sensing(most=LANDMARKS, clutter=0)
WIDTH, DEPTH = 5.0, 4.0
"""Of a room, m."""


@dataclass(frozen=True, eq=False)
class RobotTour:
    """A robot's tour.

    Attributes:
        changes: for each stop a node, and behind the first one the edge that leads to it.
        view: what a lost robot sees beside the first stop.
    """

    changes: list[list[ChangeBody]]
    view: View


def drive(robot: int, stops: int, seed: int) -> RobotTour:
    """The tour of one robot; the same in every process."""
    rng = np.random.default_rng([seed, robot])
    map_id, world = MapId(name_of(robot), 1), room(0.0, 0.0, WIDTH, DEPTH, 700, rng)
    poses = [
        Pose2(rng.uniform(1.2, WIDTH - 1.2), rng.uniform(1.2, DEPTH - 1.2), rng.uniform(-math.pi, math.pi))
        for _ in range(stops)
    ]
    nodes, edges = take_map(world, map_id, poses, rng, SENSING)
    changes: list[list[ChangeBody]] = [[NodePut(nodes[0])]]
    changes += [[NodePut(node), EdgePut(edge)] for node, edge in zip(nodes[1:], edges, strict=True)]
    beside = poses[0] @ Pose2.from_vector(rng.normal(0.0, [0.1, 0.1, 0.1]))
    return RobotTour(changes, take_view(world, beside, rng, SENSING)[0])


def name_of(robot: int) -> str:
    """The name of an agent."""
    return f"r{robot}"
