"""Where the robot was at some images of its way, and what they show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.pose import Array, Pose2, PoseGaussian


@dataclass(frozen=True, eq=False)
class Keyframes:
    """Postures of the robot at some images, and what joins and shows them.

    Attributes:
        postures: (K, 3) x m, y m, heading rad, in place; the last is now.
        slopes: (K, N, 2) where the images show the landmarks; NaN where they do not.
        steps: K - 1 measured ways from each posture to the next.
    """

    postures: Array
    slopes: Array
    steps: tuple[PoseGaussian, ...]

    @staticmethod
    def starting(posture: Pose2, count: int) -> Keyframes:
        """Nothing seen yet of `count` landmarks."""
        return Keyframes(posture.vector[None], np.full((1, count, 2), np.nan), ())

    def moved(self, change: Array) -> Keyframes:
        """With (K, 3) added."""
        return replace(self, postures=self.postures + change)

    def carried(self, place_from_old: Pose2) -> Keyframes:
        """The whole way as if the place were elsewhere."""
        postures = self.postures.copy()
        postures[:, :2] = place_from_old.apply(postures[:, :2])
        postures[:, 2] += place_from_old.heading
        return replace(self, postures=postures)

    def without(self, ids: NDArray[np.int64]) -> Keyframes:
        """Without all sightings of some landmarks."""
        slopes = self.slopes.copy()
        slopes[:, ids] = np.nan
        return replace(self, slopes=slopes)

    def extended(
        self, step: PoseGaussian, slopes: Array, apart: tuple[float, float], most: int, recent: int
    ) -> Keyframes:
        """One image more; of those that are no longer recent only some that lie apart from each other stay.

        Args:
            step: measured way since the last posture.
            slopes: (N, 2) of the new image.
            apart: m and rad by which a posture must be apart from the one before it to stay.
            most: postures that are kept; the one whose neighbours are nearest to each other goes, never the
                first, from which the way is longest, nor a recent one.
            recent: how many of the last images are kept in any case: what they show is averaged.
        """
        if len(self.postures) == 1 and not np.isfinite(self.slopes[0]).any():
            here = (Pose2.from_vector(self.postures[0]) @ step.mean).vector
            return Keyframes(here[None], slopes[None], ())
        here = (Pose2.from_vector(self.postures[-1]) @ step.mean).vector
        longer = Keyframes(
            np.vstack([self.postures, here]), np.concatenate([self.slopes, slopes[None]]), (*self.steps, step)
        )
        old = len(longer.postures) - 1 - recent
        if old >= 1 and _near(longer.steps[old - 1].mean, apart):
            return longer._dropped(old)
        if len(longer.postures) > most and old > 1:
            way = longer.postures[2 : old + 1] - longer.postures[: old - 1]
            gaps = np.hypot(way[:, 0], way[:, 1]) + 0.3 * np.abs(way[:, 2])
            return longer._dropped(1 + int(gaps.argmin()))
        return longer

    def _dropped(self, k: int) -> Keyframes:
        """Without the k-th posture, neither the first nor the last: the ways on either side become one."""
        steps = (*self.steps[: k - 1], self.steps[k - 1] @ self.steps[k], *self.steps[k + 1 :])
        return Keyframes(np.delete(self.postures, k, axis=0), np.delete(self.slopes, k, axis=0), steps)


def _near(step: Pose2, apart: tuple[float, float]) -> bool:
    return float(np.hypot(step.x, step.y)) < apart[0] and abs(step.heading) < apart[1]
