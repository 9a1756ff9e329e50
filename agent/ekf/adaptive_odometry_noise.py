"""Odometry noise of the mapping filter: larger for a while after an image has refuted the wheels."""

from __future__ import annotations

import numpy as np

from mapweave.agent.ekf.motion import WheelNoise
from mapweave.agent.ekf.settings import FilterSettings
from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array


class AdaptiveOdometryNoise:
    """The wheels' noise: nominal, or as large as images have shown it to be."""

    def __init__(self, noise: WheelNoise, settings: FilterSettings) -> None:
        """Begin with trust."""
        self._noise = noise
        self._settings = settings
        self._steps_left = 0

    @property
    def increased(self) -> bool:
        """Whether an image refuted the wheels a moment ago."""
        return self._steps_left > 0

    def root(self, odometry: Odometry) -> Array:
        """(2, 2) root of the covariance of (u1 m, u2 rad) of the step that is taken now."""
        if not self._steps_left:
            return self._noise.root(odometry)
        # Slip and lost encoders last for more than one step.
        self._steps_left -= 1
        return self._noise.refuted_root(odometry, 1.0, self._settings.slip[0])

    def side_slip(self, odometry: Odometry) -> float:
        """Standard deviation of a step's slip aside, m."""
        way = abs(odometry.forward) + self._noise.axle * abs(odometry.turn)
        return self._settings.side_slip * way

    def refuted(self, odometry: Odometry, surprise: float) -> Array:
        """The root for a step that its image refutes by so many sigmas; the next ones get more noise, too."""
        self.increase()
        return self._noise.refuted_root(odometry, surprise, self._settings.slip[0])

    def slipped(self) -> Array:
        """The root for a step in which the wheels carry no information."""
        return np.diag(self._settings.slip)

    def increase(self) -> None:
        """From now on, for a while."""
        self._steps_left = self._settings.distrust
