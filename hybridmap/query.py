"""Questions that a robot asks about the fleet's map, and their answers: plain values, no transport."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.node import EdgeKind, Node, NodeId
from mapweave.hybridmap.pose import Array, PoseGaussian


@dataclass(frozen=True, eq=False)
class View:
    """The features of one image, in columns.

    Attributes:
        pixels: (N, 2) float32, undistorted px.
        codes: (N, 32) uint8, compact SIFT descriptors.
        camera: the camera that took it; may be another than the mapping robot's.
    """

    pixels: NDArray[np.float32]
    codes: NDArray[np.uint8]
    camera: Camera

    def __len__(self) -> int:
        """How many features."""
        return len(self.pixels)


class Certainty(StrEnum):
    """Certainty of a relocalization."""

    FOUND = "found"
    PLACE = "place"
    """The place is known, but not how far from its node the view was taken: its scale was not measured."""
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


NO_COMPONENT = -1
"""Component of a node that is not in the merged map yet."""


@dataclass(frozen=True, eq=False)
class Whereabouts:
    """One place where the robot may be.

    Attributes:
        node: the node that was recognised.
        node_from_robot: the robot's pose in that node's robot frame.
        merged_from_robot: the same in the merged frame of the node's component, if it has one.
        component: number of the node's component in the merged map; `NO_COMPONENT` if it is in none.
        inliers: landmarks that agree.
        probability: that this place is the right one, 0 to 1.
        distance_known: if not, the node's scale was not measured, and the covariance includes that.
    """

    node: NodeId
    node_from_robot: PoseGaussian
    merged_from_robot: PoseGaussian | None
    component: int
    inliers: int
    probability: float
    distance_known: bool = True


@dataclass(frozen=True, eq=False)
class RelocalizeAnswer:
    """Where a view was taken: candidates best first, and the reason of the outcome, in words."""

    certainty: Certainty
    candidates: tuple[Whereabouts, ...]
    reason: str


@dataclass(frozen=True, eq=False)
class RouteLeg:
    """One hop of a route: how to get from the node before to this node.

    Attributes:
        node: the node to reach, with its landmarks.
        previous_from_node: its pose in the robot frame of the node before; identity for the first.
        kind: of the edge that is driven; None for the first node, where the route starts.
    """

    node: Node
    previous_from_node: PoseGaussian
    kind: EdgeKind | None


@dataclass(frozen=True, eq=False)
class RouteAnswer:
    """A way through the merged map. `legs[0]` is the node where the robot is; empty if there is no way."""

    legs: tuple[RouteLeg, ...]
    reason: str


@dataclass(frozen=True, eq=False)
class KnownAnswer:
    """What others have mapped around a position of a robot's own map.

    Attributes:
        views: (N, 4) [x m, y m, heading rad, horizontal semi-aperture rad], in the map of the question: the
            other robots' nodes and their fields of view, nearest first.
        reason: of the outcome, in words.
    """

    views: Array
    reason: str
