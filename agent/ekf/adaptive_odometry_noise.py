"""Odometry noise of the mapping filter: larger for a while after an image has refuted the wheels."""

import numpy as np

from mapweave.agent.ekf.motion import WheelNoise
from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array

SLIP = (0.1, 0.2)
"""Sigma of (forward m, turn rad) of a step whose wheels the landmarks refute."""
DISTRUST = 10
"""Steps after one whose wheels the landmarks refute in which wheels that claim to stand are not trusted."""


class AdaptiveOdometryNoise:
    """The wheels' noise: nominal, or as large as images have shown it to be."""

    def __init__(self, noise: WheelNoise, side_slip: float) -> None:
        """Begin with trust.

        Args:
            noise: of the wheels, as it is said.
            side_slip: standard deviation of a step's slip aside, as a share of the wheels' way.
        """
        self._noise = noise
        self._side_slip = side_slip
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
        return self._noise.refuted_root(odometry, 1.0, SLIP[0])

    def side_slip(self, odometry: Odometry) -> float:
        """Standard deviation of a step's slip aside, m."""
        way = abs(odometry.forward) + self._noise.axle * abs(odometry.turn)
        return self._side_slip * way

    def refuted(self, odometry: Odometry, surprise: float) -> Array:
        """The root (2, 2) for a step that its image refutes by so many sigmas; the next get more noise."""
        self.increase()
        return self._noise.refuted_root(odometry, surprise, SLIP[0])

    def slipped(self) -> Array:
        """The root (2, 2) for a step in which the wheels carry no information."""
        return np.diag(SLIP)

    def increase(self) -> None:
        """Use more noise from now on, for a while."""
        self._steps_left = DISTRUST
