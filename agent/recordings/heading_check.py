"""Whether the headings of poses are those in which the robot drives: else their unit or axes are others.

A robot with two driven wheels goes along its heading, forward or back. So the direction of each stretch of
the way, without regard to its sign, is the heading there.
"""

from __future__ import annotations

import math

import numpy as np

from mapweave.hybridmap.pose import Array

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
    """What is wrong with (N, 3) x m, y m, heading rad, in words; empty if nothing is, or the way is short."""
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
