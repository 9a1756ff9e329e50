"""What proximity sensors saw around a robot: that there was nothing is knowledge, too."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array

LONGEST = 60.0
"""No proximity sensor reaches further, m."""
MOST = 256
"""Sensors of one robot."""


@dataclass(frozen=True, eq=False)
class Ranges:
    """Free distances around a robot at one time.

    Attributes:
        bearings: (K,) rad, in robot; 0 ahead, positive to the left.
        distances: (K,) m, from the robot's middle to the first thing in that direction; `reach` where there
            was nothing.
        reach: how far the sensors see from the robot's middle, m; 0 without sensors.
    """

    bearings: Array = field(default_factory=lambda: np.zeros(0))
    distances: Array = field(default_factory=lambda: np.zeros(0))
    reach: float = 0.0

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together, and numbers out of range (InvalidValue)."""
        shape = np.shape(self.bearings)
        if len(shape) != 1 or np.shape(self.distances) != shape or shape[0] > MOST:
            raise InvalidValue("ranges: bearings and distances do not belong together")
        if not (np.isfinite(self.bearings).all() and 0.0 <= self.reach <= LONGEST):
            raise InvalidValue("ranges: a bearing or the reach is out of range")
        good = (self.distances >= 0.0) & (self.distances <= self.reach + 1e-9)
        if not good.all():
            raise InvalidValue(f"ranges: a distance is not within 0 to {self.reach:g} m")

    def __len__(self) -> int:
        return len(self.bearings)

    @staticmethod
    def around(proximity: NDArray[Any], bearings: tuple[float, ...], reach: float, radius: float) -> Ranges:
        """Make them of what a robot senses: free distances from its edge.

        Args:
            proximity: (K,) m, or empty.
            bearings: K, rad.
            reach: of the sensors from the robot's edge, m.
            radius: of the robot, m.
        """
        if not len(proximity) or len(proximity) != len(bearings) or reach <= 0.0:
            return Ranges()
        distances = np.clip(np.asarray(proximity, np.float64), 0.0, reach) + radius
        return Ranges(np.array(bearings, np.float64), distances, reach + radius)


NO_RANGES = Ranges()
"""Of a robot without proximity sensors."""
