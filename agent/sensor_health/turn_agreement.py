"""Whether the images turn when the odometry does: else one of the two is late, or is not what it should be.

The unit of the turns does not matter here, only their correlation over pairs of images.
"""

from collections import deque

import numpy as np

from mapweave.agent.observation import Observation
from mapweave.hybridmap.pose import Array

TURNED = 0.03
"""rad, least turn of a pair, by image or odometry, that says something."""
ENOUGH, EVERY, MOST = 24, 8, 240
"""Pairs that say something, before the first judgement, between two, and before the last."""
LEAST = 16
"""Pairs that turn by the image, and by what they are compared with: fewer have no correlation."""
AGREE = 0.9
"""Correlation with which turns agree, or a cause is found. In 32 explorations in simulation and KITTI 03, all
with right odometry, turns have 0.9 or more but for five drives."""
CONTRADICT = 0.8
"""Below it a cause is looked for. In those five drives none has more than 0.41. Odometry that is 1 s late
has at most 0.6, and in most drives 0.96 or more once that is undone."""
LEAST_LAG, MOST_LAG, STEP = 0.3, 1.5, 0.1
"""s; smaller lags are a delay, which the calibration of the drive finds."""
KEPT = 6000
"""Ticks, ten minutes, and pairs; older ones are forgotten."""
CLOCK = "the stamps of both must be of one clock"
EXCHANGED = "the images turn by what the odometry gives as ways: its columns of ways and turns are exchanged"
SIDEWAYS = (
    "the images move up or down where the odometry turns: they are turned by 90 degrees; they must be "
    "upright, and the camera's intrinsics those of upright images"
)


class TurnAgreement:
    """Watches turns of odometry and images until they agree, or a cause is found.

    Attributes:
        line: what is wrong; empty if the turns agree, or if no cause is found; None as long as it is unknown.
    """

    def __init__(self) -> None:
        """Nothing is known."""
        self.line: str | None = None
        self._odometry: deque[tuple[float, float, float]] = deque(maxlen=KEPT)
        self._pairs: deque[tuple[float, float, float, float]] = deque(maxlen=KEPT)
        self._telling = 0

    def step(self, observation: Observation) -> None:
        """Count what the odometry reports, once a tick; with a clock that goes back it begins again."""
        stamp = 1e-9 * observation.stamp_ns
        if self._odometry and stamp <= self._odometry[-1][0]:
            self._odometry.clear()
            self._pairs.clear()
            self._telling = 0
        _, turn, way = self._odometry[-1] if self._odometry else (0.0, 0.0, 0.0)
        odometry = observation.odometry
        self._odometry.append((stamp, turn + odometry.turn, way + odometry.forward))

    def add(self, first_ns: int, reported: float, turn: float, sideways: float) -> None:
        """Take in a pair of images, of which the second is that of the last tick.

        Args:
            first_ns: stamp of the first.
            reported: turn between the two by the odometry, rad.
            turn: the same by the images, to the left.
            sideways: the same, of the images turned by 90 degrees; NaN if it is not known.
        """
        if self.line is not None:
            return
        self._pairs.append((1e-9 * first_ns, self._odometry[-1][0], turn, sideways))
        if max(abs(turn), abs(reported)) < TURNED:
            return
        self._telling += 1
        if self._telling >= ENOUGH and self._telling % EVERY == 0:
            self.line = self._judged()
            if self.line is None and self._telling >= MOST:
                self.line = ""

    def _judged(self) -> str | None:
        stamps, turns, ways = np.array(self._odometry).T
        first, last, seen, sideways = np.array(self._pairs).T

        def between(counted: Array, lag: float = 0.0) -> Array:
            """(N,) by how much it grew from the first image of each pair to the last, so much later."""
            known = (first + lag >= stamps[0]) & (last + lag <= stamps[-1])
            grown = np.interp(last + lag, stamps, counted) - np.interp(first + lag, stamps, counted)
            return np.where(known, grown, np.nan)

        agreement = abs(correlation(between(turns), seen))
        if agreement >= CONTRADICT:
            return "" if agreement >= AGREE else None
        # One step more than is named: a best lag at the end of the range is none.
        steps = np.arange(LEAST_LAG, MOST_LAG + 1.5 * STEP, STEP)
        lags = [*(-steps).tolist(), *steps.tolist()]
        found = [correlation(between(turns, lag), seen) for lag in lags]
        lag = lags[int(np.argmax(found))]
        leading, late = ("images", "odometry turns") if lag > 0.0 else ("odometry", "images turn")
        causes = {
            f"the {late} {abs(lag):.1f} s after the {leading}: {CLOCK}": (
                max(found) if abs(lag) < MOST_LAG + STEP / 2 else 0.0
            ),
            EXCHANGED: correlation(between(ways), seen),
            SIDEWAYS: abs(correlation(between(turns), sideways)),
        }
        line = max(causes, key=lambda cause: causes[cause])
        return line if causes[line] >= AGREE else None


def correlation(reported: Array, seen: Array) -> float:
    """Correlation of (N,) turns by odometry and image, rad, NaN where unknown; 0 if one says too little."""
    known = np.isfinite(reported) & np.isfinite(seen)
    reported, seen = reported[known], seen[known]
    turned = [np.abs(turns) >= TURNED for turns in (reported, seen)]
    if min(each.sum() for each in turned) < LEAST:
        return 0.0
    telling = turned[0] | turned[1]
    if min(np.ptp(reported[telling]), np.ptp(seen[telling])) == 0.0:
        return 0.0
    return float(np.corrcoef(reported[telling], seen[telling])[0, 1])
