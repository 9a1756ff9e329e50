"""Ways to a goal: the fleet's map is asked; without its answer the own map leads the way."""

from __future__ import annotations

import math
from collections.abc import Collection, Generator
from dataclasses import replace
from itertools import pairwise

from mapweave.agent.cautious_driving import lacks_rangers
from mapweave.agent.localization.fix import Fix
from mapweave.agent.mission import WhichWay
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.navigation.blocks import Blocks
from mapweave.agent.navigation.onboard_router import onboard_route
from mapweave.agent.observation import Command, RobotDescription
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.query import RouteAnswer, RouteLeg

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
        """A way from where the robot is, or the reason why there is none.

        Args:
            fix: where the robot is.
            goal: the node to reach.
            blocks: where it could not drive.
        """
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
