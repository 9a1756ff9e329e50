"""Worlds of random landmarks, and nodes and views of them with known truth, for tests and benchmarks.

Nothing is rendered: descriptors are drawn in the space of decoded descriptors with the spread that real SIFT
has there, so matching, recognition, search and merging run on them as on real features.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.landmark_tables import DIMENSIONS, SYMBOLS, TOTAL_BITS, landmark_tables
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.query import View

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.25, mount_forward=0.08)


@dataclass(frozen=True)
class Sensing:
    """How well the synthetic robots see.

    Attributes:
        pixel_sigma: px.
        depth_share: standard deviation of a landmark's depth, as a share of the depth.
        code_sigma: noise of each coordinate of a decoded descriptor; two observations of one landmark are
            then about 8 code_sigma apart, unrelated ones 0.9.
        most: features an image.
        clutter: features an image that belong to nothing.
        reach: m, landmarks further away are too small.
        unknown_depth: share of a node's landmarks that have no depth.
    """

    pixel_sigma: float = 0.7
    depth_share: float = 0.03
    code_sigma: float = 0.04
    most: int = 100
    clutter: int = 20
    reach: float = 7.0
    unknown_depth: float = 0.2


@dataclass(frozen=True, eq=False)
class World:
    """Landmarks on walls.

    Attributes:
        points: (N, 3) m, in world.
        normals: (N, 2) unit vectors that point into the room.
        vectors: (N, 32) decoded descriptors.
    """

    points: Array
    normals: Array
    vectors: NDArray[np.float64]

    def __add__(self, other: World) -> World:
        """Both together. Walls do not hide each other."""
        return World(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.normals, other.normals]),
            np.concatenate([self.vectors, other.vectors]),
        )

    def moved(self, world_from_old: Pose2) -> World:
        """The same landmarks with the same descriptors elsewhere: a room that looks the same."""
        return replace(
            self, points=world_from_old.apply(self.points), normals=self.normals @ world_from_old.rotation.T
        )

    def visible(
        self, world_from_robot: Pose2, camera: Camera, reach: float
    ) -> tuple[NDArray[np.int64], Array]:
        """Which landmarks face the camera and are in its image, and (N, 3) all points in robot."""
        in_robot = world_from_robot.inverse().apply(self.points)
        towards = np.array([world_from_robot.x, world_from_robot.y]) - self.points[:, :2]
        facing = (self.normals * towards).sum(axis=1) > 0.25 * np.linalg.norm(towards, axis=1)
        seen = camera.contains(camera.project(in_robot)) & facing & (in_robot[:, 0] < reach)
        return np.flatnonzero(seen), in_robot


def random_vectors(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """(n, 32) decoded descriptors with the spread of real ones."""
    shares, symbols = landmark_tables().codes / (1 << TOTAL_BITS), np.arange(SYMBOLS)
    sigmas = np.sqrt(shares @ symbols**2 - (shares @ symbols) ** 2)
    vectors: Array = rng.normal(0, 1, (n, DIMENSIONS)) * (0.66 * sigmas / np.linalg.norm(sigmas))
    return vectors


def room(x: float, y: float, width: float, depth: float, n: int, rng: np.random.Generator) -> World:
    """A rectangular room with n landmarks on its four walls between 0.05 and 1.5 m of height."""
    corners = np.array([[x, y], [x + width, y], [x + width, y + depth], [x, y + depth]])
    lengths = np.array([width, depth, width, depth])
    wall = rng.choice(4, n, p=lengths / lengths.sum())
    start, end = corners[wall], corners[(wall + 1) % 4]
    along = rng.uniform(0.02, 0.98, (n, 1))
    normals = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])[wall]
    # Frames, sills and shelves: not everything is flat on the wall.
    plan = start + along * (end - start) + normals * rng.choice([0.0, 0.05, 0.3], (n, 1), p=[0.7, 0.2, 0.1])
    points = np.column_stack([plan, rng.uniform(0.05, 1.5, n)])
    return World(points, normals, random_vectors(n, rng))


def take_view(
    world: World,
    world_from_robot: Pose2,
    rng: np.random.Generator,
    sensing: Sensing | None = None,
    camera: Camera = CAMERA,
) -> tuple[View, NDArray[np.int64]]:
    """What a robot sees there, and the landmark behind each feature (-1 for clutter)."""
    s = sensing or Sensing()
    seen, in_robot = world.visible(world_from_robot, camera, s.reach)
    seen = rng.permutation(seen)[: s.most]
    pixels = camera.project(in_robot[seen]) + rng.normal(0, s.pixel_sigma, (len(seen), 2))
    clutter = rng.uniform(0, [camera.width, camera.height], (s.clutter, 2))
    vectors = world.vectors[seen] + rng.normal(0, s.code_sigma, (len(seen), DIMENSIONS))
    vectors = np.concatenate([vectors, random_vectors(s.clutter, rng)])
    codes = quantise(vectors)
    view = View(np.concatenate([pixels, clutter]).astype(np.float32), codes, camera)
    return view, np.concatenate([seen, np.full(s.clutter, -1)])


def take_node(
    world: World,
    node_id: NodeId,
    world_from_robot: Pose2,
    map_from_robot: PoseGaussian,
    rng: np.random.Generator,
    sensing: Sensing | None = None,
    camera: Camera = CAMERA,
) -> Node:
    """A node of a map: what is seen, most of it with a depth that is off by about its sigma."""
    s = sensing or Sensing()
    view, landmarks = take_view(world, world_from_robot, rng, s, camera)
    real = landmarks >= 0
    in_robot = world_from_robot.inverse().apply(world.points[landmarks])
    true_depths = np.where(real, in_robot[:, 0] - camera.mount_forward, rng.uniform(1, 5, len(landmarks)))
    sigmas = s.depth_share * true_depths
    depths = true_depths + rng.normal(0, 1, len(landmarks)) * sigmas
    unknown = rng.random(len(landmarks)) < s.unknown_depth
    depths[unknown] = np.nan
    sigmas = np.where(unknown, np.nan, sigmas)
    return Node(
        node_id,
        node_id.number * 1_000_000_000,
        map_from_robot,
        camera,
        Landmarks(view.pixels, view.codes, depths.astype(np.float32), sigmas.astype(np.float32)),
    )


def take_map(
    world: World,
    map_id: MapId,
    tour: list[Pose2],
    rng: np.random.Generator,
    sensing: Sensing | None = None,
    sigma_xy: float = 0.03,
    sigma_heading: float = 0.02,
) -> tuple[list[Node], list[Edge]]:
    """A robot's map of a tour: a chain of nodes in its own frame, each edge measured with noise.

    The map's frame is the first node's. Node numbers are 1, 3, 5 ..., edge numbers those between.
    """
    nodes: list[Node] = []
    edges: list[Edge] = []
    map_from_robot = PoseGaussian(Pose2(), np.zeros((3, 3)))
    for k, world_from_robot in enumerate(tour):
        node_id = NodeId(map_id.agent, map_id.epoch, 2 * k + 1)
        if k:
            true_step = tour[k - 1].inverse() @ world_from_robot
            noise = rng.normal(0, [sigma_xy, sigma_xy, sigma_heading])
            step = PoseGaussian.from_sigmas(true_step @ Pose2.from_vector(noise), sigma_xy, sigma_heading)
            map_from_robot = map_from_robot @ step
            kind = EdgeKind.TURNED if true_step.distance(Pose2()) < 0.05 else EdgeKind.MAPPED
            edge_id = NodeId(map_id.agent, map_id.epoch, 2 * k)
            edges.append(Edge(edge_id, nodes[-1].id, node_id, step, kind))
        nodes.append(take_node(world, node_id, world_from_robot, map_from_robot, rng, sensing))
    return nodes, edges
