"""A building that many synthetic robots map at the same time, for the merge at scale.

Rooms with landmarks of their own lie in a square. Each robot drives from room to room and turns around in
each; several robots come through every room, and a robot may return. Landmarks are drawn as in
`synthetic.world`, so search, verification and merging work on them as on real ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link
from synthetic.world import Sensing, World, room, take_node, take_view

WIDTH, DEPTH = 5.0, 4.0
"""Of a room, m."""
PITCH = 6.0
"""From room to room, m."""
VIEWS = 8
"""In each room, all around."""
LANDMARKS = 250
"""On the walls of a room."""
VISITS = 4
"""Of robots in each room, on average."""
SENSING = Sensing(most=80, clutter=10)
TURN_SIGMAS = np.array([0.01, 0.01, 0.005])
"""m, m, rad, of a step within a room."""
WALK_SIGMAS = np.array([0.05, 0.05, 0.02])
"""The same of the way to the next room."""
LINK_SIGMAS = np.array([0.03, 0.03, 0.01])
"""Of links that are drawn instead of searched for."""
ALIKE = math.radians(20.0)
"""Two views in one room show the same landmarks if they differ by less than this."""


@dataclass(frozen=True, eq=False)
class Building:
    """Robots' walks through rooms.

    Attributes:
        seed: of all.
        rooms: (robots, nodes) the room of each node.
        truth: (robots, nodes, 3) `world_from_robot`, m, m, rad.
    """

    seed: int
    rooms: NDArray[np.int64]
    truth: NDArray[np.float64]

    @staticmethod
    def draw(robots: int, nodes: int, seed: int) -> Building:
        """Draw the walks.

        Args:
            robots: how many.
            nodes: of each.
            seed: of the walks and the rooms.
        """
        rng = np.random.default_rng([seed, robots, nodes])
        side = max(math.ceil(math.sqrt(robots * nodes / VIEWS / VISITS)), 2)
        rooms = np.zeros((robots, nodes), np.int64)
        truth = np.zeros((robots, nodes, 3))
        ways = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        for robot in range(robots):
            room = rng.integers(0, side, 2)
            for start in range(0, nodes, VIEWS):
                count = min(VIEWS, nodes - start)
                rooms[robot, start : start + count] = room[0] * side + room[1]
                stop = room * PITCH + [WIDTH / 2, DEPTH / 2] + rng.normal(0.0, 0.25, (count, 2))
                turn = 2.0 * math.pi / VIEWS * np.arange(count) + rng.normal(0.0, 0.05, count)
                truth[robot, start : start + count] = np.column_stack([stop, turn])
                open_ = [room + way for way in ways if ((room + way >= 0) & (room + way < side)).all()]
                room = open_[int(rng.integers(len(open_)))]
        return Building(seed, rooms, truth)

    @property
    def robots(self) -> int:
        """How many."""
        return len(self.rooms)

    def world_from(self, node: NodeId) -> Pose2:
        """Where a node truly is."""
        return Pose2.from_vector(self.truth[int(node.agent[1:]), node.number // 2])

    def log(self, robot: int) -> Iterator[tuple[MapId, ChangeBody]]:
        """A robot's log: each node, then the edge that leads to it."""
        rng = np.random.default_rng([self.seed, 1, robot])
        map_id = MapId(f"r{robot}", 1)
        pose = PoseGaussian(Pose2(), np.zeros((3, 3)))
        for k in range(self.rooms.shape[1]):
            node_id = NodeId(map_id.agent, map_id.epoch, 2 * k)
            true = Pose2.from_vector(self.truth[robot, k])
            step = None
            if k:
                before = Pose2.from_vector(self.truth[robot, k - 1])
                same = self.rooms[robot, k] == self.rooms[robot, k - 1]
                sigmas = TURN_SIGMAS if same else WALK_SIGMAS
                noise = Pose2.from_vector(rng.normal(0.0, sigmas))
                step = PoseGaussian(before.inverse() @ true @ noise, np.diag(sigmas**2))
                pose = pose @ step
            world = _room(self.seed, int(self.rooms[robot, k]))
            corner = self._corner(robot, k)
            yield map_id, NodePut(take_node(world, node_id, corner.inverse() @ true, pose, rng, SENSING))
            if step is not None:
                edge_id = EdgeId(map_id.agent, map_id.epoch, 2 * k - 1)
                earlier = NodeId(map_id.agent, map_id.epoch, 2 * k - 2)
                yield map_id, EdgePut(Edge(edge_id, earlier, node_id, step, EdgeKind.MAPPED))

    def view(
        self, robot: int, k: int, node_from_robot: Pose2, rng: np.random.Generator
    ) -> tuple[View, Pose2]:
        """What a robot sees beside a node, and `world_from_robot`."""
        world_from_robot = Pose2.from_vector(self.truth[robot, k]) @ node_from_robot
        in_room = self._corner(robot, k).inverse() @ world_from_robot
        return take_view(_room(self.seed, int(self.rooms[robot, k])), in_room, rng)[0], world_from_robot

    def _corner(self, robot: int, k: int) -> Pose2:
        """World pose of the room's corner: rooms differ in what they show alone."""
        x, y, _ = self.truth[robot, k]
        # Stops are never further than a half pitch from the middle.
        cell = np.round((np.array([x, y]) - [WIDTH / 2, DEPTH / 2]) / PITCH)
        return Pose2(float(cell[0] * PITCH), float(cell[1] * PITCH), 0.0)

    def pairs(self, active: NDArray[np.bool_]) -> list[tuple[NodeId, NodeId]]:
        """Pairs of nodes that show the same, smaller id first.

        Args:
            active: (robots, nodes) which nodes there are.
        """
        result: list[tuple[NodeId, NodeId]] = []
        robots, numbers = np.nonzero(active)
        order = np.argsort(self.rooms[robots, numbers], kind="stable")
        seats = self.rooms[robots, numbers][order]
        for group in np.split(order, np.flatnonzero(np.diff(seats)) + 1):
            headings = self.truth[robots[group], numbers[group], 2]
            off = np.abs((headings[:, None] - headings + math.pi) % math.tau - math.pi)
            for i, j in np.argwhere(np.triu(off < ALIKE, 1)):
                a, b = (NodeId(f"r{robots[g]}", 1, 2 * int(numbers[g])) for g in (group[i], group[j]))
                result.append((min(a, b), max(a, b)))
        return sorted(result)

    def knowledge(self, active: NDArray[np.bool_]) -> tuple[dict[Pair, float], dict[Pair, Link]]:
        """Overlaps and links that are drawn, as if all pairs of these nodes had been compared.

        Args:
            active: (robots, nodes) which nodes there are.
        """
        rng = np.random.default_rng([self.seed, 2])
        overlaps: dict[Pair, float] = {}
        links: dict[Pair, Link] = {}
        covariance = np.diag(LINK_SIGMAS**2)
        for a, b in self.pairs(active):
            overlaps[a, b] = float(rng.uniform(8.0, 30.0))
            noise = Pose2.from_vector(rng.normal(0.0, LINK_SIGMAS))
            measured = self.world_from(a).inverse() @ self.world_from(b) @ noise
            evidence = {"inliers": float(rng.integers(15, 40)), "share": float(rng.uniform(0.5, 0.9))}
            links[a, b] = Link(a, b, PoseGaussian(measured, covariance), evidence=evidence)
        return overlaps, links


@lru_cache(maxsize=20_000)
def _room(seed: int, number: int) -> World:
    """A room with its corner in the origin."""
    rng = np.random.default_rng([seed, 3, number])
    return room(0.0, 0.0, WIDTH, DEPTH, LANDMARKS, rng)
