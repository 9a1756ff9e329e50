"""What cannot be right in recorded odometry: steps that nothing has driven, headings against the way."""

import math

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


STRETCHES = 100
"""Into which a way is cut, each at least SHORTEST long; fewer than LEAST say nothing."""
SHORTEST, LEAST = 0.05, 10
CONTRADICTS, AGREES = 0.5, 0.9
"""Mean cosine of twice the angle between way and heading: below the first they are wrong, above the second
a reading of them is right. Right ones have 0.96 to 0.98 (four explorations in simulation)."""

READINGS = (
    ("headings are in degrees; they must be in radians", np.radians),
    ("headings turn the other way than the way does; they are positive to the left", lambda h: -h),
    (
        "x and y are exchanged, or headings count clockwise from the y axis; a heading counts from x to y",
        lambda h: math.pi / 2 - h,
    ),
    ("headings are 90 degrees off the way; a heading of 0 is along x", lambda h: h + math.pi / 2),
)


def contradiction(poses: Array) -> str:
    """What is wrong with (N, 3) x m, y m, heading rad, in words; empty if nothing is, or the way is short.

    A robot with two driven wheels goes along its heading, forward or back. So the direction of each stretch
    of the way, without regard to its sign, is the heading there.
    """
    extent = float(np.hypot(*np.ptp(poses[:, :2], axis=0)))
    step = max(extent / STRETCHES, SHORTEST)
    ends = [0]
    for k, (x, y) in enumerate(poses[:, :2].tolist()):
        last = poses[ends[-1]]
        if math.hypot(x - last[0], y - last[1]) >= step:
            ends.append(k)
    if len(ends) <= LEAST:
        return ""
    moved = np.diff(poses[ends, :2], axis=0)
    middles = (np.array(ends[1:]) + ends[:-1]) // 2
    directions, headings = np.arctan2(moved[:, 1], moved[:, 0]), poses[middles, 2]

    def agreement(read: Array) -> float:
        return float(np.cos(2.0 * (directions - read)).mean())

    if np.ptp(poses[:, 2]) == 0.0 and abs(np.exp(2j * directions).mean()) < AGREES:
        return "headings are all the same while the way turns: the odometry must have them"
    if agreement(headings) > CONTRADICTS:
        return ""
    return next((words for words, read in READINGS if agreement(read(headings)) > AGREES), "")
