"""Consistency of two recognitions: whether they give the same pose.

One image may show something that occurs in another room or on every shelf, too. So a robot that wants to map
on needs a second view of other things, because it has turned or driven on in between, that gives the same
pose. In a warehouse of similar shelves single views were wrong from 12 of 28 places where the robot had never
been, two that agree from 1; in offices 36 of 37 places that were recognised by one view were recognised by
two.
"""

import math
from dataclasses import dataclass

from mapweave.hybridmap.pose import Pose2


@dataclass(frozen=True)
class PoseHypothesis:
    """The robot's pose by a recognised node.

    Attributes:
        map_from_robot: by the node.
        odom_from_robot: by the wheels.
        way: driven until then, m.
        turned: turned until then, rad, either way.
        exact: whether mapping may go on from there.
    """

    map_from_robot: Pose2
    odom_from_robot: Pose2
    way: float
    turned: float
    exact: bool


OTHER_VIEW = (1.5, 0.9)
"""A view shows other things than another if the robot has driven or turned by this in between, m and rad."""
WITHIN = (0.2, 0.1)
"""Two recognitions agree if they are no further apart than this, m and rad, and DRIFT."""
DRIFT = 0.03
"""Share of the way and of the turn in between by which two recognitions may differ: wheels are never quite
round."""


def consistent(earlier: PoseHypothesis, now: PoseHypothesis) -> bool:
    """Whether two recognitions come of different views and put the robot at the same place."""
    moved = earlier.odom_from_robot.inverse() @ now.odom_from_robot
    if abs(moved.heading) < OTHER_VIEW[1] and math.hypot(moved.x, moved.y) < OTHER_VIEW[0]:
        return False
    miss = (earlier.map_from_robot @ moved).inverse() @ now.map_from_robot
    way, turned = now.way - earlier.way, now.turned - earlier.turned
    return (
        math.hypot(miss.x, miss.y) <= WITHIN[0] + DRIFT * way
        and abs(miss.heading) <= WITHIN[1] + DRIFT * turned
    )
