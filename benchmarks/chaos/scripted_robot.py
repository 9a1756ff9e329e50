"""What each robot maps, step by step: the same in every process and after every restart."""

import numpy as np

from benchmarks.fleet.drives import drive, name_of
from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from synthetic.world import CAMERA

LANDMARKS = 60
"""Of a node, at most; the first one has more, since a lost robot is recognised by it."""
LEAST = 4
"""Nodes and edges that are left before one is retired."""


class ScriptedRobot:
    """Nodes with the edges that lead to them; some are measured again, some are retired.

    Attributes:
        map: that the robot makes.
        view: what a lost robot sees beside the first node.
    """

    def __init__(self, robot: int, seed: int) -> None:
        """Begin."""
        self.map = MapId(name_of(robot), 1)
        first = drive(robot, 1, seed)
        self.view: View = first.view
        self._first: list[ChangeBody] | None = first.changes[0]
        self._rng = np.random.default_rng([seed, robot, 1])
        (start,) = (body.node.id.number for body in first.changes[0] if isinstance(body, NodePut))
        self._nodes, self._edges, self._number = [start], list[int](), 1000

    def step(self) -> list[ChangeBody]:
        """What it adds to its log next, in one transaction."""
        if self._first is not None:
            first, self._first = self._first, None
            return first
        draw = self._rng.random()
        few = min(len(self._nodes), len(self._edges)) < LEAST
        if few or draw < 0.6:
            a, b, edge = self._nodes[-1], self._next(), self._next()
            self._nodes.append(b)
            self._edges.append(edge)
            return [self._node(b), self._edge(edge, a, b)]
        # The first node stays: lost robots are asked about it.
        if draw < 0.75:
            return [self._node(int(self._rng.choice(self._nodes[1:])))]
        if draw < 0.85:
            a, b = self._rng.choice(self._nodes, 2, replace=False)
            return [self._edge(int(self._rng.choice(self._edges)), int(a), int(b))]
        if draw < 0.93:
            return [EdgeRetired(self._id(self._edges.pop(int(self._rng.integers(len(self._edges))))))]
        return [NodeRetired(self._id(self._nodes.pop(int(self._rng.integers(1, len(self._nodes) - 1)))))]

    def _next(self) -> int:
        self._number += 1
        return self._number

    def _id(self, number: int) -> NodeId:
        return NodeId(*self.map, number)

    def _pose(self) -> PoseGaussian:
        x, y, heading = self._rng.uniform([-2.0, -2.0, -3.0], [2.0, 2.0, 3.0])
        return PoseGaussian.from_sigmas(Pose2(x, y, heading), 0.1, 0.1)

    def _node(self, number: int) -> NodePut:
        rng, count = self._rng, int(self._rng.integers(10, LANDMARKS))
        depths = rng.uniform(0.5, 5.0, count).astype(np.float32)
        seen = Landmarks(
            rng.uniform(0, 230, (count, 2)).astype(np.float32),
            rng.integers(0, 9, (count, 32)).astype(np.uint8), depths, np.float32(0.1) * depths,
        )  # fmt: skip
        return NodePut(Node(self._id(number), number, self._pose(), CAMERA, seen))

    def _edge(self, number: int, a: int, b: int) -> EdgePut:
        return EdgePut(Edge(self._id(number), self._id(a), self._id(b), self._pose(), EdgeKind.MAPPED))
