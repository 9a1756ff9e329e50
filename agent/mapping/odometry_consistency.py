"""Wheels against image: how far the two are apart since the view where an episode began.

The image corrects a wheel that slips a little. But when the two contradict each other strongly, it is unknown
which is true: a wheel may spin or an encoder be dead, or a person may carry a box through the view, which
then seems to be fixed while the room turns.
"""

from __future__ import annotations

import math

from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Pose2, wrap_angle

APART = (0.15, 0.15)
"""How far filter and wheels may be apart after any way, m and rad,"""
SHARE = 0.1
"""and besides as a share of the way and of the turns: no wheel is quite round."""


class OdometryConsistency:
    """Dead reckoning by the wheels alone, in parallel to the filter."""

    def __init__(self) -> None:
        """The two agree."""
        self.settle()

    def settle(self) -> None:
        """Restart at the filter's pose."""
        self._reckoned = Pose2()
        self._way = self._turned = 0.0

    def step(self, odometry: Odometry) -> None:
        """Go on by the wheels."""
        self._reckoned = self._reckoned @ odometry.motion()
        self._way += abs(odometry.forward)
        self._turned += abs(odometry.turn)

    def with_filter(self, anchor_from_robot: Pose2) -> bool:
        """Whether the filter's pose and the wheels' are further apart than wheels and image can be."""
        turned = abs(wrap_angle(anchor_from_robot.heading - self._reckoned.heading))
        distance = math.hypot(anchor_from_robot.x - self._reckoned.x, anchor_from_robot.y - self._reckoned.y)
        return distance > APART[0] + SHARE * self._way or turned > APART[1] + SHARE * self._turned
