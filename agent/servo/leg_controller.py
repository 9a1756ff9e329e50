"""Feedback along one leg: turn to its heading on the spot, then drive and stay on the line."""

import math
from dataclasses import dataclass

from mapweave.agent.observation import Command
from mapweave.agent.servo.laws import saturate
from mapweave.agent.servo.margins import TURN_GAIN
from mapweave.agent.servo.plan import Leg
from mapweave.hybridmap.pose import Pose2, wrap_angle

_ALIGNED = 0.04
"""rad, a turn on the spot ends here."""

_SLIPPED = 0.25
"""rad, a drive is interrupted for a turn on the spot here."""

_LOOK_AHEAD = 0.25
"""m, how far ahead on its line a leg is aimed at."""


@dataclass(frozen=True, slots=True)
class SpeedLimits:
    """Speed limits: forward m/s, turn rad/s."""

    forward: float
    turn: float


FORWARD_GAIN = 1.5
"""Gain that slows legs toward their end, 1/s."""


class LegController:
    """Drives one leg, along the line from the pose where the robot starts to drive."""

    def __init__(self, leg: Leg, last: bool, limits: SpeedLimits) -> None:
        """Take a leg.

        Args:
            leg: to be driven.
            last: whether it ends at the goal, and so must end exactly.
            limits: speed limits.
        """
        self.leg = leg
        self.turning = True
        self._last = last
        self._limits = limits
        self._heading = leg.heading
        self._aimed = False

    def remaining(self, pose: Pose2) -> float:
        """Way left along the leg, m; negative behind its end."""
        dx, dy = self.leg.x - pose.x, self.leg.y - pose.y
        return self.leg.direction * (dx * math.cos(self._heading) + dy * math.sin(self._heading))

    def command(self, pose: Pose2) -> Command | None:
        """What to do at `goal_from_robot`, or None when the leg is done."""
        limits = self._limits
        if not self._aimed:
            self._aim(pose)
        error = wrap_angle(self._heading - pose.heading)
        if self.turning and abs(error) > _ALIGNED:
            return Command(0.0, clip(TURN_GAIN * error, limits.turn))
        self.turning = False
        self._aimed = True
        left = self.remaining(pose)
        if left <= (0.002 if self._last else 0.01):
            return None
        if abs(error) > _SLIPPED:
            self.turning = True
            return Command(0.0, clip(TURN_GAIN * error, limits.turn))
        dx, dy = pose.x - self.leg.x, pose.y - self.leg.y
        aside = -dx * math.sin(self._heading) + dy * math.cos(self._heading)
        wanted = wrap_angle(
            self._heading - self.leg.direction * math.atan2(aside, _LOOK_AHEAD) - pose.heading
        )
        forward = self.leg.direction * max(FORWARD_GAIN * left, 0.01)
        return Command(
            *saturate(clip(forward, limits.forward), TURN_GAIN * wanted, limits.forward, limits.turn)
        )

    def _aim(self, pose: Pose2) -> None:
        """Head from here to the leg's end, unless that is too near to have a direction."""
        dx, dy = self.leg.x - pose.x, self.leg.y - pose.y
        if math.hypot(dx, dy) > 0.03:
            along = math.atan2(self.leg.direction * dy, self.leg.direction * dx)
            change = wrap_angle(along - self.leg.heading)
            if abs(change) < 0.15:
                self._heading = self.leg.heading + change


def clip(value: float, limit: float) -> float:
    """The value within +-limit."""
    return max(-limit, min(limit, value))
