"""The wheels' scale by proximity sensors: what is straight ahead comes nearer by what the robot drives.

A sensor that looks along the way and hits something that stands still reads

    r(t) = r0 - s U(t) + r0 tan(a) T(t)

where U is what the wheels count, T the turn meanwhile, a the angle under which it is hit, and s the true over
the counted way: whatever the angle, the reading changes by the way alone while the robot drives straight.
Camera and floor cannot tell a wrong scale from a wrong height of the camera; this is a length of its own.
"""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Odometry, RobotDescription
from mapweave.hybridmap.pose import Array

ALONG = math.radians(5.0)
"""A sensor looks along the way within this: its reading then changes by 0.4 % less than the way at most, on
a surface that it hits squarely."""
LEAST_WAY = 0.25
"""A stretch that is shorter says nothing, m;"""
MOST_WAY = 1.0
"""a longer one is cut: slip and curves go on from one to the next."""
MOST_TURN = 0.1
"""A stretch with more turning is curved, rad."""
JUMP = 0.06
"""A reading that changes by so much more than the way, m, or by a tenth of itself, has met something else."""
NOISE = (0.005, 0.01)
"""Least standard deviation of a reading: m, and share of it, as of ultrasonic and time-of-flight sensors."""
SLOPE = 1.0
"""Standard deviation of the tangent under which things are hit."""
SLIP = 0.02
"""Standard deviation of the wheels' slip over a stretch, as a share."""
FEWEST = 8
"""Stretches; fewer say nothing: some are of robots and people that move."""
MOST = 60
"""Of these the newest count."""
STUDENT = 3.0
"""Degrees of freedom of the stretches' weights."""
STEPS = 12
"""Of reweighting."""
LEAST_SIGMA = 0.01
"""Of the scale: ultrasonic sensors err by this from a cold to a warm room, others by their calibration."""


@dataclass(frozen=True)
class RangedScale:
    """What the sensors show.

    Attributes:
        log: logarithm of true over counted way.
        sigma: its standard deviation.
        stretches: of driving that it is made of.
    """

    log: float
    sigma: float
    stretches: int


@dataclass
class _Stretch:
    """Readings of one sensor on a straight way: (3,) each, counted way, turn and reading."""

    rows: list[tuple[float, float, float]] = field(default_factory=list)


class RangerScale:
    """Collects stretches while the robot drives."""

    def __init__(self, description: RobotDescription) -> None:
        """Find the sensors that look ahead and back; without any nothing is ever shown.

        One each: the beams of a scanner beside it would repeat the same slip.
        """
        bearings = np.array(description.ranger_bearings)
        aside = np.abs(np.sin(bearings))
        ways = [np.flatnonzero((aside < math.sin(ALONG)) & (np.sign(np.cos(bearings)) == s)) for s in (1, -1)]
        best = [int(way[aside[way].argmin()]) for way in ways if len(way)]
        self._beams: NDArray[np.intp] = np.array(best, np.intp)
        self._signs = np.sign(np.cos(bearings[self._beams])).tolist()
        self._count, self._reach = len(bearings), description.ranger_reach
        self._stretches = [_Stretch() for _ in self._beams]
        self._way = self._turn = 0.0
        self._scales: deque[tuple[float, float]] = deque(maxlen=MOST)

    def step(self, wheels: Odometry, proximity: Array) -> None:
        """Take what the wheels count and the sensors read in one tick."""
        self._way += wheels.forward
        self._turn += wheels.turn
        if not len(self._beams) or len(proximity) != self._count:
            return
        for stretch, sign, reading in zip(
            self._stretches, self._signs, proximity[self._beams].tolist(), strict=True
        ):
            self._follow(stretch, sign * self._way, reading)

    def _follow(self, stretch: _Stretch, way: float, reading: float) -> None:
        """Go on with a stretch, or end it and begin the next."""
        rows = stretch.rows
        if rows:
            far = abs(way - rows[0][0]) > MOST_WAY
            bent = abs(self._turn - rows[0][1]) > MOST_TURN
            expected = rows[-1][2] - (way - rows[-1][0])
            jumped = abs(reading - expected) > max(JUMP, 0.1 * reading)
            if far or bent or jumped or not 0.0 < reading < self._reach:
                self._end(stretch)
        if 0.0 < reading < self._reach:
            stretch.rows.append((way, self._turn, reading))

    def _end(self, stretch: _Stretch) -> None:
        """Least squares over a stretch; its reading at the beginning and the angle are of no interest."""
        rows, stretch.rows = np.array(stretch.rows), []
        way, turn, reading = rows.T
        if np.ptp(way) < LEAST_WAY or len(rows) < 5:
            return
        far = float(reading.mean())
        design = np.column_stack([np.ones(len(rows)), -(way - way.mean()), far * (turn - turn.mean())])
        hessian = design.T @ design
        noise = math.hypot(NOISE[0], NOISE[1] * far)
        hessian[2, 2] += (noise / SLOPE) ** 2
        solved = np.linalg.solve(hessian, design.T @ reading)
        rest = float(((reading - design @ solved) ** 2).sum()) / max(len(rows) - 3, 1)
        variance = max(rest, noise**2) * float(np.linalg.inv(hessian)[1, 1])
        if solved[1] > 0.0:
            self._scales.append((math.log(solved[1]), variance / solved[1] ** 2 + SLIP**2))

    def scale(self) -> RangedScale | None:
        """What all stretches show: a mean in which those that others do not bear out count less.

        None while they are too few, or scatter as if most were of things that move.
        """
        if len(self._scales) < FEWEST:
            return None
        logs, variances = np.array(self._scales).T
        mean = float(np.median(logs))
        for _ in range(STEPS):
            weights = (STUDENT + 1.0) / (STUDENT + (logs - mean) ** 2 / variances) / variances
            mean = float((weights * logs).sum() / weights.sum())
        off = weights * (logs - mean)
        # Sandwich: how far stretches pull apart, by the stiffness of their log likelihood.
        square = (logs - mean) ** 2 / variances
        stiffness = ((STUDENT + 1.0) * (STUDENT - square) / (STUDENT + square) ** 2 / variances).sum()
        if stiffness <= 0.0:
            return None
        sigma = math.hypot(float(np.linalg.norm(off)) / float(stiffness), LEAST_SIGMA)
        return RangedScale(mean, sigma, len(logs))
