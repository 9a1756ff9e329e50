"""Whether the robot gets nearer to its target."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass
class ProgressMonitor:
    """The least distance to the target, and its age.

    Attributes:
        step: m, nearer by this counts.
        best: m, the nearest so far.
        stood: s since the distance last decreased.
    """

    step: float = 0.03
    best: float = math.inf
    stood: float = 0.0

    def take(self, distance: float, tick: float) -> None:
        """Another tick (s) at a distance (m)."""
        self.stood += tick
        if distance < self.best - self.step:
            self.best, self.stood = distance, 0.0
