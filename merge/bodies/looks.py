"""Looks: what one robot's proximity sensors saw, node by node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.pose import Array
from hybridmap.ranges import Ranges


@dataclass(frozen=True, eq=False)
class Looks:
    """What K sensors saw at N nodes.

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
    def of(ranges: Sequence[Ranges]) -> Looks:
        """Of one robot's nodes, in their order.

        That there is nothing is also what a broken sensor says. So a look that met nothing at all, and a
        sensor that has never met anything, are not believed.
        """
        most = max((len(one) for one in ranges), default=0)
        bearings, distances = np.zeros((2, len(ranges), most))
        there, met = np.zeros((2, len(ranges), most), np.bool_)
        for k, one in enumerate(ranges):
            there[k, : len(one)] = True
            bearings[k, : len(one)], distances[k, : len(one)] = one.bearings, one.distances
            met[k, : len(one)] = one.distances < one.reach - 1e-6
        believed = there & met.any(axis=1, keepdims=True) & met.any(axis=0, keepdims=True)
        return Looks(bearings, distances, believed)
