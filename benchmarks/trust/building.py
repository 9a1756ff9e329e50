"""An office with a map as robots would have made it, and the truth about both."""

import math
from dataclasses import dataclass, replace

import networkx as nx
import numpy as np

from benchmarks.relocalize.pictures import Photographer, Wish
from benchmarks.relocalize.places import LEAST_LANDMARKS, WAY_HEADING, WAY_XY, lookouts, placed
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.sim.floorplan import BuildingPlan
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_world

MAPPER = "r0"
VIEWS = 168
"""Nodes at most: seven at each stop, a stop every metre or so."""
NEIGHBOURS = 2.2
"""Nodes up to here from each other are joined where a robot could drive straight, m."""
ROOM = 0.24
"""Clearance around the middle of a robot that drives there, m."""
STEP = 0.05


@dataclass(frozen=True, eq=False)
class MappedBuilding:
    """A building with its map.

    Attributes:
        world: as it is.
        map: as robots would have made it.
        truth: `world_from_node` of every node.
    """

    world: World
    map: HybridMap
    truth: dict[NodeId, Pose2]


def mapped_office(seed: int, rooms: int) -> MappedBuilding:
    """An office, photographed by the robot's camera; depths and ways are as wrong as a robot's."""
    world = make_world("office", seed, rooms=rooms)
    rng = np.random.default_rng([seed, 0x7A57])
    artist = Photographer(world, (seed, 1))
    truth: dict[NodeId, Pose2] = {}
    changes: list[NodePut | EdgePut] = []
    for pose in lookouts(world, VIEWS, rng):
        node = placed(artist.take(Wish(pose)), NodeId(MAPPER, 1, 2 * len(truth) + 1), 0, rng).node
        if len(node.landmarks) >= LEAST_LANDMARKS:
            truth[node.id] = pose
            changes.append(NodePut(replace(node, map_from_robot=PoseGaussian.from_sigmas(pose, 0.02, 0.01))))
    number = 2
    for a, b in _pairs(world.plan, truth):
        true = truth[a].inverse() @ truth[b]
        sigma = WAY_XY * (1.0 + math.hypot(true.x, true.y))
        noise = rng.normal(0, 1, 3) * [sigma, sigma, WAY_HEADING]
        step = PoseGaussian.from_sigmas(true @ Pose2.from_vector(noise), sigma, WAY_HEADING)
        kind = EdgeKind.TURNED if math.hypot(true.x, true.y) < STEP else EdgeKind.MAPPED
        changes.append(EdgePut(Edge(NodeId(MAPPER, 1, number), a, b, step, kind)))
        number += 2
    whole = HybridMap(changes)
    joined = max(nx.connected_components(whole.graph()), key=len)
    kept = [
        change for change in changes
        if (change.node.id if isinstance(change, NodePut) else change.edge.a) in joined
    ]  # fmt: skip
    return MappedBuilding(world, HybridMap(kept), {node: truth[node] for node in truth if node in joined})


def _pairs(plan: BuildingPlan, truth: dict[NodeId, Pose2]) -> list[tuple[NodeId, NodeId]]:
    """Nodes near each other, with floor between them on which a robot can drive straight."""
    nodes, pairs = list(truth), []
    for k, a in enumerate(nodes):
        for b in nodes[k + 1 :]:
            way = truth[a].distance(truth[b])
            if way > NEIGHBOURS:
                continue
            shares = np.linspace(0.0, 1.0, 2 + math.ceil(way / STEP))[:, None]
            ends = [np.array([truth[n].x, truth[n].y]) for n in (a, b)]
            if plan.clearances(ends[0] + shares * (ends[1] - ends[0])).min() >= ROOM:
                pairs.append((a, b))
    return pairs
