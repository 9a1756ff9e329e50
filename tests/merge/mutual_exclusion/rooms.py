"""Rooms of features, and two robots that turn about in them."""

import math

import numpy as np
import scipy.sparse

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.node import Landmarks, Node, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.ranges import Ranges
from mapweave.merge.mutual_exclusion.trajectories import BodyTrajectory, trajectories_of
from mapweave.merge.pose_graph.solved_graph import PoseGraph

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
HALF = 2.5
"""Of a square room, m."""


class Room:
    """Four walls with features, of which some may be others than a twin's."""

    def __init__(self, changed: tuple[int, ...] = ()) -> None:
        self.points, self.codes = [], []
        for wall in range(4):
            rng = np.random.default_rng([1, wall])
            along, up = rng.uniform(-HALF, HALF, 400), rng.uniform(0.0, 1.2, 400)
            angle = wall * math.pi / 2
            here = Pose2(HALF * math.cos(angle), HALF * math.sin(angle), angle)
            self.points.append(np.column_stack([here.apply(np.column_stack([0 * along, along])), up]))
            looks = np.random.default_rng([2 if wall in changed else 1, wall, 1])
            self.codes.append(looks.integers(0, 256, (400, 32), np.uint8))

    def node(self, node_id: NodeId, stamp: float, pose: Pose2, ranges: Ranges | None = None) -> Node:
        points = np.concatenate(self.points)
        seen = pose.inverse().apply(points)
        pixels = CAMERA.project(seen)
        inside = CAMERA.contains(pixels)
        # A camera far from a corner sees no wall through another one.
        shown = np.flatnonzero(inside)[:150]
        landmarks = Landmarks(
            pixels[shown].astype(np.float32), np.concatenate(self.codes)[shown],
            seen[shown, 0].astype(np.float32), np.full(len(shown), 0.02, np.float32),
        )  # fmt: skip
        origin = PoseGaussian(Pose2(), np.zeros((3, 3)))
        return Node(node_id, round(1e9 * stamp), origin, CAMERA, landmarks, "net", 0.16, ranges or Ranges())


def rays(bearing: float | None) -> Ranges:
    """64 of them go 2.3 m, but for those that a robot 0.5 m off at a bearing, rad, stops."""
    bearings, distances = np.linspace(-np.pi, np.pi, 64, endpoint=False), np.full(64, 2.3)
    if bearing is not None:
        across = 0.5 * np.sin(bearings - bearing)
        meets = (np.abs(across) < 0.16) & (np.cos(bearings - bearing) > 0.0)
        along = 0.5 * np.cos(bearings[meets] - bearing)
        distances[meets] = along - np.sqrt(0.16**2 - across[meets] ** 2)
    return Ranges(bearings, distances, 3.0)


def meeting(
    mine: Room, other: Room, late: float = 0.0, looks: int = 0, sigma: float = 0.01, seen: bool = False
) -> tuple[PoseGraph, BodyTrajectory, BodyTrajectory]:
    """Two robots half a metre apart turn on the spot; at first the first one turns with its sensors.

    Args:
        mine: what the first one sees.
        other: what the other one sees.
        late: how much later the other one comes, s.
        looks: views of the first one.
        sigma: of all poses, m and rad.
        seen: whether the first one's sensors see the second one where it is.
    """
    nodes, means = [], []
    for agent, room, x, wait in (("a", mine, 0.0, 0.0), ("b", other, 0.5, late)):
        for k in range(12):
            pose = Pose2(x, 0.0, k % 4 * math.pi / 2)
            ranges = rays(-pose.heading if seen else None) if agent == "a" and k < looks else None
            nodes.append(room.node(NodeId(agent, 1, k), wait + 4.0 * k, pose, ranges))
            means.append(pose.vector)
    information = scipy.sparse.csc_matrix(scipy.sparse.diags(np.full(3 * len(nodes), sigma**-2)))
    graph = PoseGraph(nodes[0].id, tuple(node.id for node in nodes), np.array(means), information)
    first, second = (trajectories_of([node for node in nodes if node.id.agent == agent])[0] for agent in "ab")
    return graph, first, second
