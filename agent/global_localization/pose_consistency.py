"""Consistency of two recognitions: whether they give the same pose.

One image may show something that occurs in another room or on every shelf, too. So a robot that wants to map
on needs a second view of other things, because it has turned or driven on in between, that gives the same
pose. In a warehouse of similar shelves single views were wrong from 12 of 28 places where the robot had never
been, two that agree from 1; in offices 36 of 37 places that were recognised by one view were recognised by
two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mapweave.hybridmap.pose import Pose2


@dataclass(frozen=True)
class ConsistencySettings:
    """When two recognitions agree.

    Attributes:
        turn: a view shows other things than another if the robot has turned by this in between, rad,
        way: or has driven this far, m.
        within: they agree within this, m and rad,
        drift: and this share of the way and of the turn in between: wheels are never quite round.
    """

    turn: float = 0.9
    way: float = 1.5
    within: tuple[float, float] = (0.2, 0.1)
    drift: float = 0.03


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


def consistent(earlier: PoseHypothesis, now: PoseHypothesis, settings: ConsistencySettings) -> bool:
    """Whether two recognitions are of different views and give the same pose."""
    moved = earlier.odom_from_robot.inverse() @ now.odom_from_robot
    if abs(moved.heading) < settings.turn and math.hypot(moved.x, moved.y) < settings.way:
        return False
    miss = (earlier.map_from_robot @ moved).inverse() @ now.map_from_robot
    way, turned = now.way - earlier.way, now.turned - earlier.turned
    return (
        math.hypot(miss.x, miss.y) <= settings.within[0] + settings.drift * way
        and abs(miss.heading) <= settings.within[1] + settings.drift * turned
    )
