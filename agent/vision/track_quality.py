"""What the tracks are worth just now, for people and for benchmarks; which are given up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import median
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array


class RejectionCounter:
    """Counts how often in a row a filter refused each track: it is on something that moves, or has slid."""

    def __init__(self, most: int) -> None:
        """Set how many refusals in a row a track may have before it is given up."""
        self._most = most
        self._counts: dict[int, int] = {}

    def judge(self, ids: NDArray[np.int64], accepted: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Count (N,) tracks accepted or refused; returns those to give up, whose count begins again."""
        given_up = []
        for track, good in zip(ids.tolist(), accepted.tolist(), strict=True):
            refusals = 0 if good else self._counts.get(track, 0) + 1
            if refusals >= self._most:
                given_up.append(track)
                refusals = 0
            self._counts[track] = refusals
        return np.array(given_up, np.int64)

    def forget(self) -> None:
        """Reset all counters."""
        self._counts = {}


CELLS = 4
"""The image is cut into CELLS x CELLS cells, as where features are chosen (vision/sift.py)."""


@dataclass(frozen=True, slots=True)
class TrackQuality:
    """The tracks after one image.

    Attributes:
        alive: how many there are.
        age_median: images over which they were followed, median; 0 without tracks.
        error_px_median: distance of the accepted tracks from their prediction, px, median; NaN without any.
        coverage: share of the image's cells in which there is a track.
    """

    alive: int
    age_median: float
    error_px_median: float
    coverage: float

    @staticmethod
    def of(camera: Camera, pixels: Array, ages: NDArray[np.int64], misses_px: Array) -> TrackQuality:
        """Sum up.

        Args:
            camera: whose image it is.
            pixels: (N, 2) px in the ideal image, of the tracks.
            ages: (N,) images over which they were followed.
            misses_px: (K, 2) px, of the tracks that the filter accepted: measured minus predicted.
        """
        n, errors_px = len(pixels), np.linalg.norm(misses_px, axis=1)
        return TrackQuality(
            alive=n,
            age_median=median(ages) if n else 0.0,
            error_px_median=median(errors_px) if len(errors_px) else float("nan"),
            coverage=coverage(camera, pixels),
        )

    def __str__(self) -> str:
        """The quality in one line."""
        text = f"{self.alive} tracks over {100 * self.coverage:.0f} % of the image"
        if self.alive:
            text += f", {self.age_median:.0f} images old in the median"
        if np.isfinite(self.error_px_median):
            text += f", {self.error_px_median:.2f} px from where they should be"
        return text


def coverage(camera: Camera, pixels: Array) -> float:
    """Share of the image's cells in which at least one of (N, 2) px lies."""
    inside = pixels[camera.contains(pixels)]
    column, row = (inside * CELLS / (camera.width, camera.height)).astype(int).T
    return len(np.unique(row * CELLS + column)) / CELLS**2
