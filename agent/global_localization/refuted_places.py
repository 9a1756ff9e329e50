"""Places of the fleet's map that the robot's own view did not bear out: they are not tried again at once."""

import math

from mapweave.agent.global_localization.pose_consistency import OTHER_VIEW
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2


class RefutedPlaces:
    """Nodes whose place was refuted. A node may be right when another view, from elsewhere, gives it.

    Attributes:
        count: answers that were refuted, of a node or a whole route.
    """

    def __init__(self, motion: MotionPrimitives) -> None:
        """Nothing is refuted."""
        self.count = 0
        self._motion = motion
        self._refuted: dict[NodeId, Pose2] = {}

    def add(self, node: NodeId) -> None:
        """Nothing of this node was in view, up to where the robot is now."""
        self._refuted[node] = self._motion.odom_from_robot

    def holds(self, node: NodeId) -> bool:
        """Whether the node was refuted, and the robot has hardly moved or turned since."""
        then = self._refuted.get(node)
        if then is None:
            return False
        moved = then.inverse() @ self._motion.odom_from_robot
        return abs(moved.heading) < OTHER_VIEW[1] and math.hypot(moved.x, moved.y) < OTHER_VIEW[0]
