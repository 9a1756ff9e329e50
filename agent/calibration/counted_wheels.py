"""What the wheels have counted while a robot maps, kept only where image pairs ask for it."""

import math

import numpy as np

from mapweave.agent.calibration.camera_motions import WheelTrack
from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array

FIRST_ROOM = 2048
"""Readings for which there is room at first: three minutes at 10 Hz."""


class CountedWheels:
    """Readings of the wheels, summed up, in an array with room for more.

    A robot runs for days, and the pairs that turn most are kept from its first minutes: what was counted
    between pairs is forgotten, or memory and the time of each solution would grow with the hours.
    """

    def __init__(self) -> None:
        """Nothing was counted yet."""
        self._columns: Array = np.zeros((3, FIRST_ROOM))
        self._count = 0

    @property
    def stamp(self) -> float:
        """Time of the last reading, s; minus infinity without one."""
        return float(self._columns[0, self._count - 1]) if self._count else -math.inf

    @property
    def way(self) -> float:
        """Counted so far, m, backwards negative."""
        return float(self._columns[1, self._count - 1]) if self._count else 0.0

    @property
    def full(self) -> bool:
        """Whether there is no room for another reading: `forget_between` makes some, else `add` does."""
        return self._count == len(self._columns[0])

    def add(self, stamp: float, wheels: Odometry) -> None:
        """Take a reading, at a later time, s, than the one before."""
        if self.full:
            self._columns = np.concatenate([self._columns, np.zeros_like(self._columns)], axis=1)
        way, turn = self._columns[1:, self._count - 1].tolist() if self._count else (0.0, 0.0)
        self._columns[:, self._count] = stamp, way + wheels.forward, turn + wheels.turn
        self._count += 1

    def track(self) -> WheelTrack:
        """All that is kept."""
        return WheelTrack(*self._columns[:, : self._count])

    def forget_between(self, begins: Array, ends: Array) -> None:
        """Forget the readings that lie in none of (N,) intervals of time, s; the last one stays."""
        stamps = self._columns[0, : self._count]
        inside = np.zeros(self._count + 1, np.int64)
        np.add.at(inside, np.searchsorted(stamps, begins, side="left"), 1)
        np.add.at(inside, np.searchsorted(stamps, ends, side="right"), -1)
        kept = np.cumsum(inside[:-1]) > 0
        kept[-1:] = True
        columns = np.zeros_like(self._columns)
        count = int(np.count_nonzero(kept))
        columns[:, :count] = self._columns[:, : self._count][:, kept]
        self._columns, self._count = columns, count
