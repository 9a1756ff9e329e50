"""Wheels against image: how far the two are apart since the view where an episode began.

A wheel that slips a little is corrected by the image, and that is what the image is for. But when the two
tell quite different stories nobody on board knows which is true: a wheel may spin or an encoder be dead, or
somebody may carry a box through the view, which then seems to stand still while the room turns.
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
    """Reckons by the wheels alone, beside the filter."""

    def __init__(self) -> None:
        """The two agree."""
        self.settle()

    def settle(self) -> None:
        """Begin anew from where the filter is."""
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
        far = math.hypot(anchor_from_robot.x - self._reckoned.x, anchor_from_robot.y - self._reckoned.y)
        return far > APART[0] + SHARE * self._way or turned > APART[1] + SHARE * self._turned
