"""Too few landmarks in view: turn to where more are, else back off along the optical axis."""

import numpy as np

from mapweave.agent.observation import Command
from mapweave.agent.servo.field_of_view import FieldOfView
from mapweave.agent.servo.leg_controller import SpeedLimits, clip
from mapweave.agent.servo.margins import LEAST_MARGIN, MIN_VISIBLE, TURN_GAIN
from mapweave.agent.servo.plan import Surroundings
from mapweave.agent.servo.servo_step import State
from mapweave.hybridmap.pose import Pose2

RETREAT = 0.6
"""Longest way back along the optical axis to find landmarks again, m."""


_OFFSETS = np.linspace(-0.8, 0.8, 33)
"""rad, turns on the spot that are tried."""


class Recovery:
    """Brings landmarks back into view. Backing off narrows all bearings: tried when no turn helps."""

    def __init__(self, limits: SpeedLimits) -> None:
        """Prepare."""
        self._limits = limits
        self._retreat_from: Pose2 | None = None

    def over(self) -> None:
        """Enough is in view again: the next retreat may be as long as this one could have been."""
        self._retreat_from = None

    def command(self, pose: Pose2, field: FieldOfView, around: Surroundings) -> tuple[Command, State, str]:
        """What to do at `goal_from_robot` with too few landmarks in view."""
        count = len(_OFFSETS)
        poses = np.column_stack([np.full(count, pose.x), np.full(count, pose.y), pose.heading + _OFFSETS])
        fine = np.flatnonzero(field.slack(poses) >= 2.0 * LEAST_MARGIN)
        if len(fine):
            offset = float(_OFFSETS[fine[np.abs(_OFFSETS[fine]).argmin()]])
            turn = clip(TURN_GAIN * offset, self._limits.turn)
            return Command(0.0, turn), "turning", "turning back to the landmarks"
        if self._retreat_from is None:
            self._retreat_from = pose
        room = RETREAT - pose.distance(self._retreat_from)
        behind, here = (
            float(around.distance((pose @ Pose2(-0.1)).vector)),
            float(around.distance(pose.vector)),
        )
        if room > 0.0 and behind >= min(around.clearance, here) and field.count >= MIN_VISIBLE:
            return Command(-0.5 * self._limits.forward), "retreating", "backing off to see more landmarks"
        return Command(), "stuck", "too few landmarks in view"
