"""How much further the robot has turned than its mapping filter says, by pairs of images.

The filter models motion in the plane, with the geometry in use. On a road that bends or tilts the camera
pitches and rolls, and the filter takes that for turning: 1 to 3 degrees in 500 m; and 4 degrees in 60 m while
the camera's heading is declared wrongly. A pair of images is reduced with a pitch and roll of its own, with
all tracks, and with the newest estimate of the geometry. How noisy the filter is depends on the floor, so
that is estimated from how far the two are apart (expectation maximisation).
"""

import math
from typing import NamedTuple

FIRST = math.radians(0.05)
"""Standard deviation of the filter's turn over a pair before any has shown it, rad: between what was measured
in buildings (0.03 degrees) and on a street (0.085); see docs/decisions/turns-by-pairs.md."""
ADAPTATION = 0.1
"""Share of what a pair shows of it that is taken over at once, 0 ... 1; chosen."""
MOST = 4.0
"""Sigmas of the two together: what is further apart counts as this far (Huber 1981); chosen."""


class PairTurn(NamedTuple):
    """How far a robot has turned from one image to another, by these and the wheels.

    Attributes:
        turned: rad.
        variance: rad^2.
    """

    turned: float
    variance: float


class TurnCorrection:
    """Weighs the turns of image pairs against those of the filter, and sums up what is to be corrected."""

    def __init__(self) -> None:
        """Begin with nothing to correct."""
        self._variance = FIRST**2
        self._sum = 0.0

    def add(self, pair: PairTurn, by_filter: float) -> None:
        """Take what a pair and the filter say of the same time.

        Args:
            pair: as it was reduced.
            by_filter: turn, rad; whole turns do not count.
        """
        both = self._variance + pair.variance
        most = MOST * math.sqrt(both)
        apart = min(max(math.remainder(pair.turned - by_filter, math.tau), -most), most)
        gain = self._variance / both
        shown = (gain * apart) ** 2 + gain * pair.variance
        self._variance += ADAPTATION * (shown - self._variance)
        self._sum += gain * apart

    def take(self) -> float:
        """What the robot has turned further since this was called last, rad."""
        out, self._sum = self._sum, 0.0
        return out
