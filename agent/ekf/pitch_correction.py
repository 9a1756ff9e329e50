"""A camera that nods, over a kerb, on a rough floor or where a road bends: all that it sees moves up or down.

The filter models motion in the plane only. A pitch of half a degree moves every landmark by several pixels in
the same direction, and precise landmarks then fail each other's gates, or refute the wheels. Pitch differs
from wrong landmarks and wheels in one way: no motion in the plane moves everything up.
"""

import math
from typing import NamedTuple

import numpy as np

from mapweave.agent.arrays import median
from mapweave.hybridmap.pose import Array

LEAST = 8
"""Landmarks that an offset is read off; fewer may be wrong together."""
SIGMAS = 4.0
"""An offset is evident if it is so many times what the filter expects the landmarks to move together."""
MEDIAN_VARIANCE = math.pi / 2.0
"""Of the median of many Gaussian errors, over that of their mean."""


class PitchOffset(NamedTuple):
    """By how much the camera looks further up than the filter's landmarks say.

    Attributes:
        pitch: rad.
        variance: of its error, rad^2.
        offsets: (N, 2) to subtract from the slopes: the derivative of a pinhole camera's slopes (a, b) with
            respect to pitch, (a b, 1 + b^2), times the pitch.
    """

    pitch: float
    variance: float
    offsets: Array


def pitch_offset(innovations: Array, covariance: Array, slopes: Array) -> PitchOffset | None:
    """What a pitch of the camera has added to the innovations, if one is evident.

    Args:
        innovations: (N, 2) slopes, measured minus expected.
        covariance: (2N, 2N) of these, joint: what the filter takes to be possible without a pitch.
        slopes: (N, 2) as they are measured.

    Returns:
        The median of the landmarks' pitch estimates; None if the filter may be wrong by as much in the plane.
    """
    if len(innovations) < LEAST:
        return None
    by_pitch = np.stack([slopes[:, 0] * slopes[:, 1], 1.0 + slopes[:, 1] ** 2], axis=1)
    covariances = covariance[1::2, 1::2] / np.outer(by_pitch[:, 1], by_pitch[:, 1])
    # Landmarks of unknown depth move up or down by themselves while the robot drives. So it is read off the
    # surest, as many as make the variance of their mean least.
    order = covariances.diagonal().argsort(kind="stable")
    sums = covariances[np.ix_(order, order)].cumsum(axis=0).cumsum(axis=1).diagonal()
    expected = (sums / np.arange(1, len(order) + 1) ** 2)[LEAST - 1 :]
    more = int(expected.argmin())
    surest = order[: LEAST + more]
    pitch = median(innovations[surest, 1] / by_pitch[surest, 1])
    variance = MEDIAN_VARIANCE * float(expected[more])
    return PitchOffset(pitch, variance, pitch * by_pitch) if pitch**2 > SIGMAS**2 * variance else None
