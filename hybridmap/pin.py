"""Pins: a person holds the frame of a component by the pose of one of its nodes."""

import math
from dataclasses import dataclass
from typing import ClassVar

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2

FARTHEST = 1e5
"""Largest coordinate of a pinned node, m: the component around it has to stay within a message's range."""


@dataclass(frozen=True, slots=True)
class Pin:
    """A node has this pose in the merged map, whatever else changes: its component is moved so as a whole.

    Attributes:
        node: the node.
        merged_from_node: its pose.
    """

    TAG: ClassVar[str] = "pin"
    node: NodeId
    merged_from_node: Pose2

    def __post_init__(self) -> None:
        """Refuse a pose far away (InvalidValue)."""
        pose = self.merged_from_node
        # Written so that NaN fails.
        if not (abs(pose.x) <= FARTHEST and abs(pose.y) <= FARTHEST and math.isfinite(pose.heading)):
            raise InvalidValue(f"pin {self.node}: give a position within {FARTHEST:g} m")

    @property
    def anchor(self) -> NodeId:
        """The node by which its position is known."""
        return self.node

    @property
    def words(self) -> str:
        """The pin in words."""
        pose = self.merged_from_node
        return f"at {pose.x:z.3f},{pose.y:z.3f} m, {math.degrees(pose.heading):z.1f} deg"
