"""What the tracks are worth just now, for people and for benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array

CELLS = 4
"""The image is cut into CELLS x CELLS cells, as where features are chosen (vision/sift.py)."""


@dataclass(frozen=True, slots=True)
class TrackQuality:
    """The tracks after one image.

    Attributes:
        alive: how many there are.
        age_median: images over which they were followed, median; 0 without tracks.
        age_longest: and the most; 0 without tracks.
        held: share of them that was found by the patch in which it was first seen, not only from frame to
            frame; NaN without tracks.
        error_px_median: distance of the accepted tracks from their prediction, px, median; NaN without any.
        error_px_p95: likewise, 95th percentile.
        coverage: share of the image's cells in which there is a track.
    """

    alive: int
    age_median: float
    age_longest: int
    held: float
    error_px_median: float
    error_px_p95: float
    coverage: float

    @staticmethod
    def of(
        camera: Camera, pixels: Array, ages: NDArray[np.int64], held: NDArray[np.bool_], misses_px: Array
    ) -> TrackQuality:
        """Sum up.

        Args:
            camera: whose image it is.
            pixels: (N, 2) px in the ideal image, of the tracks.
            ages: (N,) images over which they were followed.
            held: (N,) whether they were found by their first patch.
            misses_px: (K, 2) px, of the tracks that the filter accepted: measured minus predicted.
        """
        n = len(pixels)
        median, worst = float("nan"), float("nan")
        if len(misses_px):
            median, worst = (float(q) for q in np.percentile(np.linalg.norm(misses_px, axis=1), (50, 95)))
        return TrackQuality(
            alive=n,
            age_median=float(np.median(ages)) if n else 0.0,
            age_longest=int(ages.max()) if n else 0,
            held=float(held.mean()) if n else float("nan"),
            error_px_median=median,
            error_px_p95=worst,
            coverage=coverage(camera, pixels),
        )

    def __str__(self) -> str:
        """In one line."""
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
