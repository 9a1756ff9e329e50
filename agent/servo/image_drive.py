"""The exploration drive of the paper: forth and back, features kept in view, obstacles kept away."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import median
from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.servo.leg_controller import clip

ACCELERATION = 0.3
"""Of the speed profile at both ends, m/s^2."""
CENTRE_GAIN = 0.6
"""Gain of turns toward the middle of the features, 1/s."""
CENTRE_BAND = 0.06
"""The middle may be this far off before it matters, rad: the way stays almost straight."""
HEADING_GAIN = 0.8
"""Gain that holds the heading of the start, 1/s."""
BORDER = 0.06
"""Features nearer to the border than this are about to be lost, rad."""
MIN_VISIBLE = 6
"""The drive turns round before fewer features than this have room to the border."""
SLOW = 0.35
"""Distance of an obstacle from the edge at which the drive slows, m."""
STOP = 0.12
"""Distance of an obstacle from the edge at which the drive turns round, m."""
DEFLECT = 0.15
"""Largest deflection from an obstacle that is near on one side, rad/s."""
CONE = 0.9
"""Rangers within this of the direction of travel matter, rad."""


class ImageDrive:
    """Drives a way forth and back again, steered by the features' bearings alone."""

    def __init__(self, description: RobotDescription, speed: float = 0.2) -> None:
        """Prepare for a robot; `start` must come before each drive.

        Args:
            description: of the robot.
            speed: m/s.
        """
        self._wanted = speed
        self._description = description
        rangers = np.asarray(description.ranger_bearings, dtype=np.float64)
        # Of each ranger, off the direction of travel: forward, and backward.
        self._offsets = [
            np.mod(rangers - behind + math.pi, 2.0 * math.pi) - math.pi for behind in (0.0, math.pi)
        ]
        self._facing = [np.abs(offsets) <= CONE for offsets in self._offsets]
        self.start(0.0)

    def start(self, distance: float) -> None:
        """Begin: `distance` m forth (backward if negative), then back to where the drive began."""
        self._distance = distance
        self._outward = True
        self._turned_at = distance
        self._reason = "complete"

    def command(
        self, travelled: float, heading_error: float, bearings: NDArray[Any], proximity: NDArray[Any]
    ) -> tuple[Command, bool, str]:
        """One tick.

        Args:
            travelled: m since the start, signed, forward positive.
            heading_error: rad, heading now less the heading at the start.
            bearings: (N,) rad of the tracked features, positive to the left.
            proximity: (K,) m from the robot's edge.

        Returns:
            The command, whether the drive is over, and in words what it does or why it turned round.
        """
        bearings = np.asarray(bearings, dtype=np.float64)
        sense = math.copysign(1.0, self._distance)
        if self._outward:
            obstacle = self._free(self._near(sense, proximity)) <= STOP
            few = sense > 0 and self._safe(bearings) < MIN_VISIBLE
            if obstacle or few or sense * (self._distance - travelled) <= 0.005:
                self._outward = False
                self._turned_at = travelled
                if obstacle:
                    self._reason = "turned round: an obstacle " + ("ahead" if sense > 0 else "behind")
                elif few:
                    self._reason = "turned round: features were leaving the view"
        if not self._outward and sense * travelled <= 0.005:
            return Command(), True, self._reason
        direction = sense if self._outward else -sense
        near = self._near(direction, proximity)
        free = self._free(near)
        if not self._outward and free <= STOP:
            return Command(), True, "ended: an obstacle on the way back"
        forward = direction * self._speed(travelled, free)
        turn = self._turn(direction, heading_error, bearings, near)
        return Command(forward, turn), False, "driving forth" if self._outward else "driving back"

    def _speed(self, travelled: float, free: float) -> float:
        """m/s: ramps at both ends of the way, slower toward obstacles."""
        ends = (0.0, self._distance) if self._outward else (self._turned_at, 0.0)
        way = min(abs(travelled - ends[0]), abs(travelled - ends[1]))
        ramp = math.sqrt(2.0 * ACCELERATION * max(way, 0.0))
        share = clip(max(free - STOP, 0.0) / (SLOW - STOP), 1.0)
        top = min(self._wanted, self._description.max_forward)
        return max(min(ramp, top), min(0.03, top)) * max(share, 0.15)

    def _turn(
        self, direction: float, heading_error: float, bearings: NDArray[Any], near: NDArray[np.float64]
    ) -> float:
        """rad/s: hold the heading; give way to features off the middle, and to obstacles on one side."""
        turn = -HEADING_GAIN * heading_error
        if len(bearings):
            middle = median(bearings)
            aside = max(abs(middle) - CENTRE_BAND, 0.0)
            turn += CENTRE_GAIN * math.copysign(aside, middle)
            room = self._description.camera.semi_aperture - BORDER
            out_left, out_right = int((bearings > room).sum()), int((bearings < -room).sum())
            turn += 0.15 * CENTRE_GAIN * (out_left - out_right) / len(bearings)
        if len(near):
            distances, offsets = near.T
            weight = np.clip((SLOW - distances) / SLOW, 0.0, 1.0)
            # An obstacle ahead on the left pushes to the right; while backing the sides change roles.
            turn -= direction * DEFLECT * clip(float((weight * np.sign(offsets)).sum()), 1.0)
        return clip(turn, 0.5 * self._description.max_turn)

    def _near(self, direction: float, proximity: NDArray[Any]) -> NDArray[np.float64]:
        """(M, 2) distance m and bearing off the direction of travel rad (left of the robot positive)."""
        distances = np.asarray(proximity, dtype=np.float64)
        forward = direction > 0
        offsets, facing = self._offsets[not forward], self._facing[not forward]
        count = min(len(distances), len(offsets))
        chosen = np.flatnonzero(facing[:count] & np.isfinite(distances[:count]))
        near = np.empty((len(chosen), 2))
        near[:, 0], near[:, 1] = distances[chosen], offsets[chosen] if forward else -offsets[chosen]
        return near

    def _free(self, near: NDArray[np.float64]) -> float:
        """Free way in the direction of travel, m: to the nearest thing within the width of the robot."""
        if not len(near):
            return math.inf
        radius = self._description.radius
        reach = near[:, 0] + radius
        ahead = reach * np.cos(near[:, 1])
        aside = np.abs(reach * np.sin(near[:, 1]))
        in_the_way = aside < radius + 0.05
        return float((ahead - radius)[in_the_way].min()) if in_the_way.any() else math.inf

    def _safe(self, bearings: NDArray[Any]) -> int:
        """How many features have room to the border."""
        room = self._description.camera.semi_aperture - BORDER
        return int((np.abs(bearings) <= room).sum())
