"""Lens distortion, removed from points rather than from images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array

Distortion = tuple[float, float, float, float, float]
"""(k1, k2, p1, p2, k3), OpenCV's order."""

EXACT = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-10)
"""OpenCV's five steps leave up to 0.1 px in the corners of a webcam's image."""


class Lens:
    """Maps pixels of the real image to pixels of the ideal pinhole camera and back."""

    def __init__(self, camera: Camera, distortion: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)) -> None:
        """Take the camera's intrinsics and the lens's five coefficients."""
        self._matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        self._distortion = np.array(distortion)
        self._ideal = not self._distortion.any()

    def undistort(self, raw: NDArray[Any]) -> Array:
        """(N, 2) px in the real image -> (N, 2) px in the ideal one."""
        raw = np.asarray(raw, dtype=np.float64).reshape(-1, 2)
        if self._ideal or not len(raw):
            return raw.copy()
        out = cv2.undistortPoints(
            raw[:, None], self._matrix, self._distortion, P=self._matrix, criteria=EXACT
        )
        return np.asarray(out, dtype=np.float64).reshape(-1, 2)

    def distort(self, pixels: NDArray[Any]) -> Array:
        """(N, 2) px in the ideal image -> (N, 2) px in the real one."""
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        if self._ideal or not len(pixels):
            return pixels.copy()
        focal = np.array([self._matrix[0, 0], self._matrix[1, 1]])
        rays = np.ones((len(pixels), 3))
        rays[:, :2] = (pixels - self._matrix[:2, 2]) / focal
        out, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self._matrix, self._distortion)
        return np.asarray(out, dtype=np.float64).reshape(-1, 2)
