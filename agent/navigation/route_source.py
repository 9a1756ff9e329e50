"""Ways to a goal: the fleet's map is asked; without its answer the own map leads the way."""

import math
from collections.abc import Collection, Generator, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from mapweave.agent.cautious_driving import lacks_rangers
from mapweave.agent.localization.fix import Fix
from mapweave.agent.mission import WhichWay
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.navigation.blocks import Blocks
from mapweave.agent.observation import Command, RobotDescription
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Obstacle, RouteAnswer, RouteLeg
from mapweave.hybridmap.reachability import closed_edges
from mapweave.hybridmap.route import RouteTable
from mapweave.hybridmap.segments import distances


def onboard_route(
    own_map: HybridMap,
    start: NodeId,
    goal: NodeId,
    blocked: Collection[tuple[NodeId, NodeId]] = (),
    obstacles: Collection[Obstacle] = (),
) -> RouteAnswer:
    """Find the cheapest route between two nodes of the own map.

    Relative poses are those of the edges: nothing is optimised here, so a long route is as precise as its
    hops together.

    Args:
        own_map: of this robot.
        start: node by which the robot is localized.
        goal: the node to reach.
        blocked: pairs of nodes, in either order, between which the robot cannot drive.
        obstacles: places that it cannot pass; those at nodes of other maps are left out.
    """
    barred = {*blocked, *_past(own_map, obstacles)}
    route = RouteTable(own_map, blocked=barred, closed=closed_edges(own_map)).find(start, goal)
    if not route.nodes:
        return RouteAnswer((), f"own map: {route.reason}")
    origin = PoseGaussian(Pose2(), np.zeros((3, 3)))
    legs = [RouteLeg(own_map.nodes[start], origin, None)]
    for (before, node), edge in zip(pairwise(route.nodes), route.edges, strict=True):
        relative = own_map.edge_between(before, node)
        assert relative is not None, "the route runs along edges"
        legs.append(RouteLeg(own_map.nodes[node], relative, own_map.edges[edge].kind))
    return RouteAnswer(tuple(legs), f"own map: {route.reason}")


def _past(own_map: HybridMap, obstacles: Collection[Obstacle]) -> Iterator[tuple[NodeId, NodeId]]:
    """The pairs of nodes between which a robot would pass an obstacle."""
    poses = {node.id: node.map_from_robot.mean for node in own_map.nodes.values()}
    known = [one for one in obstacles if one.node in poses]
    pairs = [(e.a, e.b) for e in own_map.edges.values() if e.a in poses and e.b in poses]
    if not known or not pairs:
        return
    begin, end = (np.array([(poses[pair[k]].x, poses[pair[k]].y) for pair in pairs]) for k in (0, 1))
    centres = [poses[one.node] @ Pose2(one.x, one.y) for one in known]
    off = distances(np.array([(pose.x, pose.y) for pose in centres]), begin, end)
    near = off < np.array([one.reach for one in known])[:, None]
    yield from (pairs[k] for k in np.flatnonzero(near.any(axis=0)).tolist())


RECOGNISED = (EdgeKind.LOOP, EdgeKind.MERGED)
"""Edges between places that look alike, which no robot need have driven. A robot without proximity sensors
avoids those that are longer than its radius."""


class RouteSource:
    """Where a navigator gets its routes.

    Attributes:
        refusing: whether the fleet says that there is no way, although the robot has not reported any block.
    """

    def __init__(self, motion: MotionPrimitives, own_map: HybridMap, description: RobotDescription) -> None:
        """Take the means: the motion primitives ask the fleet, and stand until the answer comes."""
        self.refusing = False
        self._motion, self._own_map, self._description = motion, own_map, description

    def route(self, fix: Fix, goal: NodeId, blocks: Blocks) -> Generator[Command, None, RouteAnswer]:
        """A way from where the robot is, or the reason why there is none."""
        blocked, obstacles = blocks.pairs(self._motion.now), blocks.obstacles(self._motion.now)
        here = fix.node_from_robot.mean
        question = WhichWay(self._motion.number(), fix.node, goal, here, blocked, obstacles)
        answer = yield from self._motion.ask(question)
        content, trouble = answer.content, ""
        if not isinstance(content, RouteAnswer):
            trouble = f"{answer.error or 'no answer'}; "
            content = onboard_route(self._own_map, fix.node, goal, blocked, obstacles)
        self.refusing = not (trouble or blocked or obstacles)
        return replace(content, reason=f"{trouble}{content.reason}")

    def undriven(self, route: Collection[RouteLeg]) -> tuple[NodeId, NodeId] | None:
        """The first leg of a route that no robot has driven; None without one, or if there are rangers."""
        if not lacks_rangers(self._description):
            return None
        for before, leg in pairwise(route):
            way = math.hypot(leg.previous_from_node.mean.x, leg.previous_from_node.mean.y)
            if leg.kind in RECOGNISED and way > self._description.radius:
                return before.node.id, leg.node.id
        return None
