"""Occupancy grid made of submaps, which move with the nodes of the map when loops close.

The pose in the map drifts, so that a robot that comes back to a place draws its walls a second time, beside
the first. Within a few metres the drift is small: what the rangers see on such a stretch is a submap, a rigid
piece that is fixed to a node (Hess, Kohler, Rapp, Andor: Real-time loop closure in 2D lidar SLAM, ICRA 2016).
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import RobotDescription
from mapweave.agent.occupancy_grid import MOST, OccupancyGrid
from mapweave.agent.settings import OccupancyGridSettings
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2

STRETCH = 3.0
"""A submap is of what was seen within this of where it begins, m."""
MOST_SUBMAPS = 1000
"""The oldest are forgotten beyond these, 15 MB."""


@dataclass
class Submap:
    """What was seen on one stretch.

    Attributes:
        node: to which it is fixed; None before there is any.
        map_from_node: pose of the node by the robot's own way.
        odds: (R, C) log-odds; rows along x, columns along y of the map, as it was drawn first.
        corner: (2,) m in map, where the first cell begins.
        moved: `map_from_map`: by how much it is drawn elsewhere than at first.
    """

    node: NodeId | None
    map_from_node: Pose2
    odds: NDArray[np.float16]
    corner: Array
    moved: Pose2 = field(default_factory=Pose2)


class SubmapGrid(OccupancyGrid):
    """A grid that is drawn again where a loop closure shows that what was seen lies elsewhere."""

    def __init__(self, description: RobotDescription, settings: OccupancyGridSettings | None = None) -> None:
        """Start with everything unknown."""
        super().__init__(description, settings)
        side = 2.0 * (STRETCH + description.ranger_reach + 1.0)
        self._stretch_settings = replace(self._settings, side=side)
        self._submaps: deque[Submap] = deque(maxlen=MOST_SUBMAPS)
        self._node: tuple[NodeId | None, Pose2] = None, Pose2()
        self._begun: Array | None = None
        self._open = OccupancyGrid(description, self._stretch_settings)

    def see_node(self, node: Node) -> None:
        """Take note of a new node. What is seen on a stretch is fixed to one that is about its middle."""
        pose = node.map_from_robot.mean
        if self._begun is None or np.linalg.norm([pose.x, pose.y] - self._begun) <= STRETCH / 2:
            self._node = node.id, pose

    def see(self, map_from_robot: Pose2, proximity: Array) -> None:
        """See OccupancyGrid."""
        super().see(map_from_robot, proximity)
        here = np.array([map_from_robot.x, map_from_robot.y])
        if self._begun is None or np.linalg.norm(here - self._begun) > STRETCH:
            self._end_submap()
            self._begun = here
            self._open.roll(here)
        self._open.see(map_from_robot, proximity)

    def go_on_from(self, node: Node) -> None:
        """The robot was lost and has recognised a node: what it sees from now on is fixed to that."""
        self._end_submap()
        self._begun, self._node = None, (node.id, node.map_from_robot.mean)

    def _end_submap(self) -> None:
        self._submaps.extend(self._taken_submap())
        self._open = OccupancyGrid(self._description, self._stretch_settings)

    def correct(self, map_from_node: Mapping[NodeId, Pose2]) -> bool:
        """Draw the grid again where nodes lie elsewhere than the robot's own way says, by more than a cell.

        Args:
            map_from_node: where they lie as seen from where the robot is: what is seen now stays.

        Returns:
            Whether it was drawn again.
        """
        moved = [self._moved(submap, map_from_node) for submap in self._submaps]
        if not any(
            self._shift(submap, now) > self._settings.cell
            for submap, now in zip(self._submaps, moved, strict=True)
        ):
            return False
        self._odds[:] = 0.0
        for submap, now in zip(self._submaps, moved, strict=True):
            submap.moved = now
            self._draw(submap)
        for submap in self._taken_submap():
            self._draw(submap)
        return True

    @staticmethod
    def _moved(submap: Submap, map_from_node: Mapping[NodeId, Pose2]) -> Pose2:
        """Where it is to be drawn; where it is if its node has gone."""
        pose = None if submap.node is None else map_from_node.get(submap.node)
        return submap.moved if pose is None else pose @ submap.map_from_node.inverse()

    def _shift(self, submap: Submap, now: Pose2) -> float:
        """How far a corner of it would move, m."""
        corners = self._corners(submap)
        return float(np.linalg.norm(now.apply(corners) - submap.moved.apply(corners), axis=1).max())

    def _corners(self, submap: Submap) -> Array:
        """(4, 2) m in map, as it was drawn first."""
        ends = np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) * submap.odds.shape
        return np.asarray(submap.corner + ends * self._settings.cell)

    def _draw(self, submap: Submap) -> None:
        corners = submap.moved.apply(self._corners(submap))
        (top, left), (bottom, right) = self.cells(corners.min(axis=0)), self.cells(corners.max(axis=0))
        # Where in the submap the first of these cells is, and its neighbours below and beside it.
        cells = np.array([[top, left], [top + 1, left], [top, left + 1]])
        points = submap.moved.inverse().apply(self.centres(cells))
        first, below, beside = ((points - submap.corner) / self._settings.cell - 0.5)[:, ::-1]
        from_cell = np.stack([beside - first, below - first, first], axis=1)
        part = cv2.warpAffine(
            submap.odds.astype(np.float32), from_cell, (int(right - left) + 1, int(bottom - top) + 1),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        )  # fmt: skip
        into = self._odds[top : bottom + 1, left : right + 1]
        np.clip(into + part, -MOST, MOST, out=into)

    def _taken_submap(self) -> list[Submap]:
        """The stretch until now; nothing if it shows nothing."""
        taken = self._open.taken()
        known = np.argwhere(taken.odds != 0.0)
        if not len(known):
            return []
        low, high = known.min(axis=0), known.max(axis=0) + 1
        odds = taken.odds[low[0] : high[0], low[1] : high[1]].astype(np.float16)
        return [Submap(*self._node, odds, taken.corner + low * taken.side)]
