"""Tiles of the floor ahead, each aligned from one image to another as its plane lets it appear.

A floor has little texture and is seen at a grazing angle: over the way of one pair a patch of road grows by
half. A window that is only shifted loses it or slides. Here the plane predicts how each tile is distorted,
and one unknown is left: how far off it is, along the line on which the camera's motion lets it move. Direct
alignment in a region ahead of the vehicle is how Song and Chandraker (Robust scale estimation in real-time
monocular SFM, 2014) measure the height over the road; tiles leave it to `floor_scale.py` which of them are
floor.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.camera_motions import CameraMotions
from mapweave.agent.calibration.pair_information import FLOOR_STEEPNESS, FloorMatches
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import Lens

WIDTH_PX, HEIGHT_PX = 16, 8
ABREAST = 1.0
"""Tiles lie this many heights of the camera to either side of it: what a vehicle drives on, no verge."""
MOST = 48
MARGIN_PX = 4
BLUR_PX = 0.8
SEARCHED = np.arange(-0.3, 0.31, 0.05)
"""Logarithms of inverse depth over the floor's with which a tile is tried first,"""
STEPS = 4
"""and Gauss-Newton steps from the best."""
LEAST_CORRELATION = 0.85
"""Of a tile with where it is found;"""
AMBIGUOUS = 0.1
"""no place further off than two steps of the search may correlate as well but for this: a pattern repeats."""
STEP = 0.02
"""Of the numeric derivative by a logarithm."""
INDEPENDENT = 0.25
"""Share of a tile's pixels that count: blur makes neighbours alike."""
LEAST_SIGMA_PX = 0.1
"""Interpolation and lens."""


class FloorTiles:
    """Where tiles of the floor can lie in the images of one camera."""

    def __init__(self, camera: Camera, lens: Lens) -> None:
        """Take the camera of the images, and their lens."""
        self._camera, self._lens = camera, lens
        self._focal = np.array([camera.fx, camera.fy])
        self._centre = np.array([camera.cx, camera.cy])
        self._top = max(math.floor(camera.cy), 0)
        rows = np.arange(self._top + MARGIN_PX, camera.height - MARGIN_PX - HEIGHT_PX, HEIGHT_PX)
        columns = np.arange(MARGIN_PX, camera.width - MARGIN_PX - WIDTH_PX, WIDTH_PX)
        corner = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
        y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
        self._pixels = corner + np.stack([x, y], axis=-1).reshape(1, -1, 2)
        ideal = lens.undistort(self._pixels.reshape(-1, 2).astype(np.float64))
        rays = np.column_stack([(ideal - self._centre) / self._focal, np.ones(len(ideal))])
        self._rays = rays.reshape(*self._pixels.shape[:2], 3)

    def part(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """What matters of an image, (H, W) grey: below the middle row, a little blurred."""
        below = image[self._top :].astype(np.float32)
        return np.asarray(cv2.GaussianBlur(below, (0, 0), BLUR_PX), np.float32)

    def match(
        self, before: NDArray[np.float32], after: NDArray[np.float32], at: CameraMotions
    ) -> FloorMatches:
        """Align the tiles.

        Args:
            before: part of the first image.
            after: part of the second.
            at: one motion between them.
        """
        middle = self._rays.mean(axis=1)
        steepness = middle @ (at.floor / np.linalg.norm(at.floor))
        ahead = (steepness > FLOOR_STEEPNESS) & (np.abs(middle[:, 0]) < ABREAST * steepness)
        chosen = np.flatnonzero(ahead)
        if before.shape != after.shape or not len(chosen):
            return FloorMatches.none()
        column, row = np.moveaxis(self._pixels[chosen], -1, 0)
        template = before[row - self._top, column]
        # Texture along the way counts: gradients down the image.
        energy = np.square(np.diff(template.reshape(-1, HEIGHT_PX, WIDTH_PX), axis=1)).sum((1, 2))
        best = np.sort(np.argsort(-energy, kind="stable")[:MOST])
        chosen, template = chosen[best], template[best]
        warp = _Warp(self, self._rays[chosen], at)
        template = template - template.mean(axis=1, keepdims=True)
        logs, unique = self._searched(template, after, warp)
        step = sigma = np.zeros(0)
        for _ in range(STEPS):
            shown, slope = warp.sampled(after, logs)
            gain = (template * shown).sum(1) / np.maximum((shown**2).sum(1), 1e-6)
            error, slope = gain[:, None] * shown - template, gain[:, None] * slope
            stiffness = (slope**2).sum(1) + 1e-6
            step = np.clip(-(slope * error).sum(1) / stiffness, -0.05, 0.05)
            logs = np.clip(logs + step, -1.0, 1.0)
            sigma = np.sqrt((error**2).sum(1) / (INDEPENDENT * error.shape[1] * stiffness))
        shown, _ = warp.sampled(after, logs)
        pixels = warp.pixels(logs)
        inside = ((pixels > 2) & (pixels < [self._camera.width - 3, self._camera.height - 3])).all((1, 2))
        kept = inside & unique & (_correlation(template, shown) > LEAST_CORRELATION) & (np.abs(step) < 0.02)
        sigma = np.minimum(sigma, 1.0)
        moved = warp.middle(logs + 0.5 * sigma) - warp.middle(logs - 0.5 * sigma)
        across = np.hypot(np.linalg.norm(moved, axis=1), LEAST_SIGMA_PX / self._camera.fy)
        return FloorMatches(middle[chosen][kept, :2], warp.middle(logs)[kept], across[kept])

    def _searched(
        self, template: Array, after: NDArray[np.float32], warp: _Warp
    ) -> tuple[Array, NDArray[np.bool_]]:
        """(N,) best of the logarithms that are tried, and whether no other is as good."""
        part = slice(None, None, 2)
        tried = np.stack(
            [
                _correlation(template[:, part], warp.sampled(after, np.full(len(template), log), part)[0])
                for log in SEARCHED
            ]
        )
        best = tried.argmax(axis=0)
        near = np.abs(np.arange(len(SEARCHED))[:, None] - best) <= 2
        other = np.where(near, -1.0, tried).max(axis=0)
        return SEARCHED[best], other < tried.max(axis=0) - AMBIGUOUS


class _Warp:
    """Where pixels of tiles are in the second image, by the logarithms of their inverse depths."""

    def __init__(self, tiles: FloorTiles, rays: Array, at: CameraMotions) -> None:
        self._tiles = tiles
        self._turned = rays @ at.rotation.T
        self._floor = rays @ at.floor
        self._translation = at.translation

    def normalised(self, logs: Array, part: slice) -> Array:
        """(N, P, 2) normalised coordinates."""
        rho = self._floor[:, part] * np.exp(logs)[:, None]
        y = self._turned[:, part] + rho[..., None] * self._translation
        return np.asarray(y[..., :2] / np.maximum(y[..., 2:], 0.05))

    def middle(self, logs: Array) -> Array:
        """(N, 2) normalised coordinates of the tiles' middles."""
        turned, floor = self._turned.mean(axis=1), self._floor.mean(axis=1)
        y = turned + (floor * np.exp(logs))[:, None] * self._translation
        return np.asarray(y[:, :2] / np.maximum(y[:, 2:], 0.05))

    def pixels(self, logs: Array, part: slice = slice(None)) -> Array:
        """(N, P, 2) px in the real image."""
        tiles = self._tiles
        ideal = self.normalised(logs, part) * tiles._focal + tiles._centre
        return tiles._lens.distort(ideal.reshape(-1, 2)).reshape(ideal.shape)

    def sampled(
        self, after: NDArray[np.float32], logs: Array, part: slice = slice(None)
    ) -> tuple[Array, Array]:
        """(N, P) values there less each tile's mean, and (N, P) how they change with the logarithms."""
        top = np.array([0.0, self._tiles._top])
        values = []
        for off in (-STEP, STEP):
            column, row = np.moveaxis((self.pixels(logs + off, part) - top).astype(np.float32), -1, 0)
            values.append(cv2.remap(after, column, row, cv2.INTER_LINEAR).astype(np.float64))
        shown, slope = 0.5 * (values[0] + values[1]), (values[1] - values[0]) / (2.0 * STEP)
        return shown - shown.mean(axis=1, keepdims=True), slope - slope.mean(axis=1, keepdims=True)


def _correlation(one: Array, other: Array) -> Array:
    """(N,) of rows that have no mean."""
    size = np.sqrt((one**2).sum(axis=1) * (other**2).sum(axis=1))
    return np.asarray((one * other).sum(axis=1) / np.maximum(size, 1e-6))
