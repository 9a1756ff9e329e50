"""What an image shows of the mapping filter's landmarks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.innovations import Examined, examine
from mapweave.agent.ekf.landmark_estimates import Ids
from mapweave.agent.ekf.mapping_state import LEAST_AGREEING, MappingState, WheelStep
from mapweave.agent.ekf.update_report import Health, UpdateReport
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array

SLIP_SIGMAS = 4.5
"""Wheels that an image refutes by more than so many sigmas have slipped. Chosen: a wheel that errs by no more
than its noise passes it once in 150 000 steps, 4 h at 10 Hz; at 3 it would be once in 370, 37 s."""
RELINEARISATIONS = 3
"""How often at most a step is linearised again in the light of its image, unless nothing changes any more
before (`SAME_STEP`). With none, the mean NEES of the pose is 21 instead of 2.7 after 50 s
(docs/decisions/ekf-parametrisation.md, moving rays)."""


class Pinhole:
    """Pixels and slopes of an ideal camera.

    Attributes:
        focal: (2,) px.
        centre: (2,) px, principal point.
    """

    def __init__(self, camera: Camera) -> None:
        """Make the model of a camera by its intrinsics."""
        self.focal = np.array([camera.fx, camera.fy])
        self.centre = np.array([camera.cx, camera.cy])

    def slopes(self, pixels: Array) -> Array:
        """(N, 2) slopes (a, b) of pixels (N, 2)."""
        return np.asarray((pixels - self.centre) / self.focal, np.float64)

    def pixels(self, slopes: Array) -> Array:
        """(N, 2) px of slopes (N, 2)."""
        return np.asarray(self.centre + self.focal * slopes, np.float64)


def slots_of(held: Ids, ids: Ids) -> NDArray[np.intp]:
    """(N,) places in the state of landmarks by their ids; -1 for those that it does not hold.

    Args:
        held: (n,) ids of the state's landmarks, each once.
        ids: (N,) of which landmarks.
    """
    if not len(held):
        return np.full(len(ids), -1, np.intp)
    order = held.argsort()
    slots = order.take(held.take(order).searchsorted(ids), mode="clip")
    slots[held.take(slots) != ids] = -1
    return np.asarray(slots, np.intp)


class ImageMeasurement(NamedTuple):
    """The landmarks of a filter that an image shows.

    Attributes:
        tracked: how many landmarks were, N.
        slots: (m,) places in the state of what is held and seen.
        rows: (m,) their rows among the ids.
        slopes: (m, 2) where they are seen, (pixel - principal point) / focal length.
        focal: (2,) px.
    """

    tracked: int
    slots: NDArray[np.intp]
    rows: NDArray[np.intp]
    slopes: Array
    focal: Array

    @staticmethod
    def of(held: Ids, ids: Ids, pixels: Array, pinhole: Pinhole) -> ImageMeasurement:
        """What of the landmarks held is seen.

        Args:
            held: (n,) ids in the state's order.
            ids: (N,) what was tracked.
            pixels: (N, 2) px, undistorted; rows with NaN are not seen.
            pinhole: of the camera.
        """
        places = slots_of(held, ids)
        rows = np.flatnonzero((places >= 0) & np.isfinite(pixels).all(axis=1))
        return ImageMeasurement(len(ids), places[rows], rows, pinhole.slopes(pixels[rows]), pinhole.focal)

    def compared(
        self, step: WheelStep | None, settled: MappingState, variances: Array
    ) -> tuple[WheelStep | None, Examined]:
        """Compare an image with its prediction.

        Args:
            step: that brought the robot to where the image was taken, if there was one.
            settled: the state before it.
            variances: (2,) of a slope.

        Returns:
            The step, linearised where it seems to have gone, and what came out.
        """
        if step is not None and RELINEARISATIONS and len(self.slots) >= LEAST_AGREEING:
            return step.linearised_by_image(self.slots, self.slopes, variances, SLIP_SIGMAS)
        expected = settled if step is None else step.state
        return step, examine(expected.rays, expected.covariance, self.slots, self.slopes, variances)

    def report(
        self, inliers: NDArray[np.bool_], innovations: Array, mean_nis: float, health: Health, reason: str
    ) -> UpdateReport:
        """Report of an update: inliers (m,), innovations (m, 2) slopes measured minus expected."""
        accepted, innovations_px = np.zeros(self.tracked, np.bool_), np.full((self.tracked, 2), np.nan)
        accepted[self.rows], innovations_px[self.rows] = inliers, innovations * self.focal
        return UpdateReport(accepted, innovations_px, mean_nis, health, reason)
