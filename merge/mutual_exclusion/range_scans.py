"""Looks: what one robot's proximity sensors saw, moment by moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import TrajectorySegment


@dataclass(frozen=True, eq=False)
class RangeScans:
    """What K sensors saw at N moments.

    Attributes:
        bearings: (N, K) rad, in robot.
        distances: (N, K) m, from the robot's middle to the first thing; the sensors' reach where there was
            nothing.
        seen: (N, K) whether there is a sensor that can be believed.
    """

    bearings: Array
    distances: Array
    seen: NDArray[np.bool_]

    @staticmethod
    def of(ranges: Sequence[Ranges], wakes: Sequence[TrajectorySegment]) -> RangeScans:
        """Of one robot's nodes, in their order, and then of their wakes, likewise.

        That there is nothing is also what a broken sensor says. So a look that met nothing at all, and a
        sensor that has never met anything, are not believed.
        """
        looks = [*((one, one.distances) for one in ranges)]
        looks += [(one, row) for one, wake in zip(ranges, wakes, strict=True) for row in wake.distances]
        most = max((len(one) for one in ranges), default=0)
        bearings, distances = np.zeros((2, len(looks), most))
        there, met = np.zeros((2, len(looks), most), np.bool_)
        for k, (one, row) in enumerate(looks):
            there[k, : len(one)] = True
            bearings[k, : len(one)], distances[k, : len(one)] = one.bearings, row
            met[k, : len(one)] = row < one.reach - 1e-6
        believed = there & met.any(axis=1, keepdims=True) & met.any(axis=0, keepdims=True)
        return RangeScans(bearings, distances, believed)

    def take(self, order: NDArray[np.int64]) -> RangeScans:
        """Some of the looks, or all in another order."""
        return RangeScans(self.bearings[order], self.distances[order], self.seen[order])
