"""Range scans: one robot's proximity readings, moment by moment."""

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
        seen: (N, K) whether there is a valid reading.
    """

    bearings: Array
    distances: Array
    seen: NDArray[np.bool_]

    @staticmethod
    def of(ranges: Sequence[Ranges], segments: Sequence[TrajectorySegment]) -> RangeScans:
        """Of one robot's nodes, in their order, and then of their trajectory segments, likewise.

        A broken sensor also reports that there is nothing. So a scan without any reading in range, and a
        sensor without any, are not used.
        """
        scans = [*((node_ranges, node_ranges.distances) for node_ranges in ranges)]
        scans += [
            (node_ranges, row)
            for node_ranges, segment in zip(ranges, segments, strict=True)
            for row in segment.distances
        ]
        most = max((len(node_ranges) for node_ranges in ranges), default=0)
        bearings, distances = np.zeros((2, len(scans), most))
        present, met = np.zeros((2, len(scans), most), np.bool_)
        for k, (node_ranges, row) in enumerate(scans):
            present[k, : len(node_ranges)] = True
            bearings[k, : len(node_ranges)], distances[k, : len(node_ranges)] = node_ranges.bearings, row
            met[k, : len(node_ranges)] = row < node_ranges.reach - 1e-6
        valid = present & met.any(axis=1, keepdims=True) & met.any(axis=0, keepdims=True)
        return RangeScans(bearings, distances, valid)

    def take(self, order: NDArray[np.int64]) -> RangeScans:
        """Some of the scans, or all in another order."""
        return RangeScans(self.bearings[order], self.distances[order], self.seen[order])
