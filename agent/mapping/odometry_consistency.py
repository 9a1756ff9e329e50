"""Wheels against image: how far the two are apart since the view where an episode began.

The image corrects a wheel that slips a little. But when the two contradict each other strongly, it is unknown
which is true: a wheel may spin or an encoder be dead, or a person may carry a box through the view, which
then seems to be fixed while the room turns. One image may mislead the filter, over a bump of the road, and
the next ones correct it: the contradiction must last. And a camera that stands elsewhere on the robot than is
assumed moves otherwise in turns: that is no dispute while calibration is about to find it out.
"""

import math

from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Pose2, wrap_angle

APART = (0.15, 0.15)
"""How far filter and wheels may be apart after any way, m and rad,"""
SHARE = 0.1
"""and besides as a share of the way and of the turns: no wheel is quite round."""
LASTING = 5
"""Images in a row that must contradict the wheels: half a second. A car that nods over a bump took three."""


class OdometryConsistency:
    """Dead reckoning by the wheels alone, in parallel to the filter.

    Attributes:
        contradicting: how many images in a row have contradicted the wheels.
        lever_error: how far from where it is assumed the camera may stand on the robot, m.
    """

    def __init__(self) -> None:
        """The two agree."""
        self.lever_error = 0.0
        self.settle()

    def settle(self) -> None:
        """Restart at the filter's pose."""
        self._reckoned = Pose2()
        self._way = self._turned = 0.0
        self.contradicting = 0

    @property
    def disputed(self) -> bool:
        """Whether wheels and images contradict each other for so long that it is unknown which is true."""
        return self.contradicting >= LASTING

    def step(self, odometry: Odometry) -> None:
        """Go on by the wheels."""
        self._reckoned = self._reckoned @ odometry.motion()
        self._way += abs(odometry.forward)
        self._turned += abs(odometry.turn)

    def compare(self, anchor_from_robot: Pose2) -> None:
        """Hold the filter's pose after an image against the wheels': may they be so far apart?"""
        turned = abs(wrap_angle(anchor_from_robot.heading - self._reckoned.heading))
        distance = math.hypot(anchor_from_robot.x - self._reckoned.x, anchor_from_robot.y - self._reckoned.y)
        may_be = APART[0] + SHARE * self._way + self.lever_error * self._turned
        apart = distance > may_be or turned > APART[1] + SHARE * self._turned
        self.contradicting = self.contradicting + 1 if apart else 0
