"""Synthetic fleets: maps that drift, links that are true, and links that are false.

Only poses are drawn, no landmarks: the input is what verification would return. False links occur as in
buildings: a place that looks like another gives one to four of them, which agree with each other and with as
many landmarks as true ones have.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import CODE_BYTES, Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.merge.pose_graph.links import Link

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.25, mount_forward=0.08)
BARE = Landmarks(
    pixels=np.zeros((0, 2), np.float32),
    codes=np.zeros((0, CODE_BYTES), np.uint8),
    depths=np.zeros(0, np.float32),
    depth_sigmas=np.zeros(0, np.float32),
)
STEP_SIGMAS = np.array([0.03, 0.03, 0.015])
"""Of a robot's own edges, m, m, rad."""
LINK_SIGMAS = np.array([0.03, 0.03, 0.01])
"""Of links, m, m, rad."""


@dataclass(frozen=True)
class FleetSettings:
    """What is drawn.

    Attributes:
        robots: how many.
        nodes: of each robot.
        side: of the square floor, m.
        true_links: wanted; fewer if there are not as many pairs with a common view.
        same: nodes at most so far apart, m, with headings within 30 degrees, show the same place.
        apart: nodes of one map that are fewer steps apart are no loop.
        most_alike: most links that one aliased place gives.
    """

    robots: int = 4
    nodes: int = 60
    side: float = 12.0
    true_links: int = 40
    same: float = 1.0
    apart: int = 10
    most_alike: int = 4


@dataclass(frozen=True, eq=False)
class SyntheticFleet:
    """Maps, links, and the truth about them.

    Attributes:
        maps: by id.
        links: all, shuffled.
        true: pairs of those that are true.
        truth: `world_from_robot` of each node.
    """

    maps: dict[MapId, HybridMap]
    links: tuple[Link, ...]
    true: frozenset[tuple[NodeId, NodeId]]
    truth: dict[NodeId, Pose2]


def draw_fleet(
    false_share: float, rng: np.random.Generator, settings: FleetSettings | None = None
) -> SyntheticFleet:
    """Draw a fleet.

    Args:
        false_share: of all links, from 0 to below 1.
        rng: source of all that is random.
        settings: sizes.
    """
    s = settings or FleetSettings()
    maps: dict[MapId, HybridMap] = {}
    truth: dict[NodeId, Pose2] = {}
    for k in range(s.robots):
        map_id = MapId(f"r{k}", 1)
        walk = walk_of(s, rng)
        maps[map_id] = map_of(map_id, walk, rng)
        truth |= {NodeId(map_id.agent, 1, n): pose for n, pose in enumerate(walk)}
    true = _true_links(truth, s, rng)
    wanted = round(len(true) * false_share / (1.0 - false_share))
    false = _false_links(truth, {link.pair for link in true}, wanted, s, rng)
    links = [*true, *false]
    order = rng.permutation(len(links))
    return SyntheticFleet(maps, tuple(links[k] for k in order), frozenset(link.pair for link in true), truth)


def map_of(map_id: MapId, walk: list[Pose2], rng: np.random.Generator) -> HybridMap:
    """A robot's map of a walk, in its own frame, by edges that are off by about `STEP_SIGMAS`."""
    hybrid_map, covariance = HybridMap(), np.diag(STEP_SIGMAS**2)
    current = PoseGaussian(Pose2(), np.zeros((3, 3)))
    for k, pose in enumerate(walk):
        node_id = NodeId(map_id.agent, map_id.epoch, k)
        step = None
        if k:
            noise = Pose2.from_vector(rng.normal(0, STEP_SIGMAS))
            step = PoseGaussian(walk[k - 1].inverse() @ pose @ noise, covariance)
            current = current @ step
        hybrid_map.apply(NodePut(Node(node_id, k * 1_000_000_000, current, CAMERA, BARE)))
        if step is not None:
            before = NodeId(map_id.agent, map_id.epoch, k - 1)
            edge_id = EdgeId(map_id.agent, map_id.epoch, len(walk) + k)
            hybrid_map.apply(EdgePut(Edge(edge_id, before, node_id, step, EdgeKind.MAPPED)))
    return hybrid_map


def walk_of(s: FleetSettings, rng: np.random.Generator) -> list[Pose2]:
    """Steps of 0.7 m with turns, and turns about at the walls."""
    pose = Pose2.from_vector(rng.uniform([1.0, 1.0, -math.pi], [s.side - 1.0, s.side - 1.0, math.pi]))
    walk = [pose]
    while len(walk) < s.nodes:
        step = pose @ Pose2(0.7, 0.0, rng.normal(0.0, 0.3))
        inside = 0.0 < step.x < s.side and 0.0 < step.y < s.side
        pose = step if inside else pose @ Pose2(0.0, 0.0, rng.uniform(0.5, 1.0))
        walk.append(pose)
    return walk


def _pairs(truth: dict[NodeId, Pose2], s: FleetSettings) -> tuple[list[NodeId], NDArray[np.bool_], Array]:
    """Nodes; (N, N) upper triangle of those that could be linked; (N, N) m, how far they are apart."""
    nodes = sorted(truth)
    place = np.array([truth[node].vector for node in nodes])
    robot = np.array([int(node.agent[1:]) for node in nodes])
    number = np.array([node.number for node in nodes])
    distance = np.hypot(*(place[:, None, :2] - place[None, :, :2]).transpose(2, 0, 1))
    distinct = (robot[:, None] != robot) | (np.abs(number[:, None] - number) >= s.apart)
    return nodes, np.triu(distinct, 1), distance


def link_between(a: NodeId, b: NodeId, a_from_b: Pose2, rng: np.random.Generator) -> Link:
    """A link that is off by about `LINK_SIGMAS`, with as many landmarks as links have."""
    measured = a_from_b @ Pose2.from_vector(rng.normal(0, LINK_SIGMAS))
    evidence = {"inliers": float(rng.integers(15, 50)), "share": float(rng.uniform(0.4, 0.9))}
    return Link(a, b, PoseGaussian(measured, np.diag(LINK_SIGMAS**2)), evidence=evidence)


def _true_links(truth: dict[NodeId, Pose2], s: FleetSettings, rng: np.random.Generator) -> list[Link]:
    nodes, distinct, distance = _pairs(truth, s)
    heading = np.array([truth[node].heading for node in nodes])
    turn = np.abs((heading[:, None] - heading + math.pi) % math.tau - math.pi)
    pairs = np.argwhere(distinct & (distance < s.same) & (turn < math.radians(30.0)))
    chosen = rng.permutation(pairs)[: s.true_links]
    ends = [(nodes[i], nodes[j]) for i, j in chosen]
    return [link_between(a, b, truth[a].inverse() @ truth[b], rng) for a, b in ends]


def _false_links(
    truth: dict[NodeId, Pose2],
    taken: set[tuple[NodeId, NodeId]],
    wanted: int,
    s: FleetSettings,
    rng: np.random.Generator,
) -> list[Link]:
    """Perceptual aliasing: some nodes near one place seem to be near another."""
    nodes, distinct, distance = _pairs(truth, s)
    candidates = np.argwhere(distinct & (distance > 2.0 * s.same))
    taken = set(taken)
    links: list[Link] = []
    while len(links) < wanted:
        a, b = (nodes[k] for k in candidates[rng.integers(len(candidates))])
        seeming = Pose2.from_vector(rng.uniform([-0.7, -0.7, -0.5], [0.7, 0.7, 0.5]))
        moved = truth[a] @ seeming @ truth[b].inverse()
        for k in range(int(rng.integers(1, s.most_alike + 1))):
            first, second = (NodeId(node.agent, node.epoch, node.number + k) for node in (a, b))
            fresh = first in truth and second in truth and (first, second) not in taken
            if fresh and first < second and len(links) < wanted:
                taken.add((first, second))
                links.append(link_between(first, second, truth[first].inverse() @ moved @ truth[second], rng))
    return links
