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
    def of(
        ranges: Sequence[Ranges], segments: Sequence[TrajectorySegment], owners: NDArray[np.int64]
    ) -> RangeScans:
        """The scans of one robot's nodes, in their order, and then of their trajectory segments, likewise.

        A broken sensor also reports that there is nothing. So a scan without any reading in range, and a
        sensor without any, are not used.

        Args:
            ranges: of the nodes.
            segments: of those nodes that have any.
            owners: (N,) which node each scan is of.
        """
        widths = np.array([len(node_ranges) for node_ranges in ranges], np.int64)
        most = int(widths.max(initial=0))
        reaches = np.array([node_ranges.reach for node_ranges in ranges])
        by_node = _rows([node_ranges.bearings[None] for node_ranges in ranges], most)
        distances = _rows(
            [
                *(node_ranges.distances[None] for node_ranges in ranges),
                *(segment.distances for segment in segments),
            ],
            most,
        )
        bearings = by_node[owners]
        present = (np.arange(most) < widths[:, None])[owners]
        met = present & (distances < (reaches[owners] - 1e-6)[:, None])
        valid = present & met.any(axis=1, keepdims=True) & met.any(axis=0, keepdims=True)
        return RangeScans(bearings, distances, valid)

    def take(self, order: NDArray[np.int64]) -> RangeScans:
        """Some of the scans, or all in another order."""
        return RangeScans(self.bearings[order], self.distances[order], self.seen[order])


def _rows(parts: Sequence[Array], width: int) -> Array:
    """Arrays (n, k) below each other, with zeros up to a width of at least all k."""
    padded = [
        part if part.shape[1] == width else np.pad(part, ((0, 0), (0, width - part.shape[1])))
        for part in parts
    ]
    out: Array = np.concatenate([np.zeros((0, width)), *padded])
    return out
