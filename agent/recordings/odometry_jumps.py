"""Steps of odometry that no robot has driven, as where the counts of an encoder wrap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array

JUMP = 5.0
"""A step so many times as fast as all others is none. In right recordings (KITTI 03, drives with exact poses,
an exploration in simulation) the fastest steps are at most 1.02 times as fast as the next one. A wrap of 16
bits of 0.2 mm, seen every 0.1 s, is 16 times as fast as the car of KITTI, 400 times as a robot at 0.3 m/s."""
MOST = 4
"""So many jump at the most: the counts of two wheels wrap, each between two poses around an image."""
DRIVING = 10
"""So many times as many other steps must have a comparable speed: else the robot has hardly driven."""


def bridged(increments: Array, stamps_ns: NDArray[np.int64]) -> tuple[Array, list[str]]:
    """Odometry without steps that jump, as where the counts of an encoder wrap.

    Args:
        increments: (N, 2) m and rad since the image before.
        stamps_ns: (N,) of the images, ascending.

    Returns:
        (N, 2) the same where nothing jumps; a step that does goes on at the speed of the one before. And a
        line that says so, if any does.
    """
    gaps = np.diff(stamps_ns) * 1e-9
    speeds = np.abs(increments[1:, 0]) / gaps
    order = np.argsort(speeds, kind="stable")[::-1]
    fastest = speeds[order]
    for count in range(min(MOST, len(speeds) - 1), 0, -1):
        others = fastest[count]
        driving = (speeds > others / JUMP).sum() - count
        if fastest[count - 1] > JUMP * others and driving >= DRIVING * count:
            break
    else:
        return increments, []
    jumps, whole = np.sort(order[:count]).tolist(), increments.copy()
    for k in jumps:
        whole[k + 1] = whole[k] * (gaps[k] / gaps[k - 1]) if k else 0.0
    often = "once" if count == 1 else f"{count} times"
    at = float(stamps_ns[jumps[0] + 1] - stamps_ns[0]) * 1e-9
    return whole, [
        f"the odometry jumps {often}, first by {increments[jumps[0] + 1, 0]:.3g} m at image {jumps[0] + 1}, "
        f"{at:.1f} s after the first; all other steps are slower than {others:.2g} m/s. Did the counts of an "
        "encoder wrap? The robot counts as driving on as before"
    ]
