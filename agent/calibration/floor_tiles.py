"""Tiles of the floor ahead, each aligned from one image to another as its plane lets it appear.

A floor has little texture and is seen at a grazing angle: over the way of one pair a patch of road grows by
half. A window that is only shifted loses it or slides. Here the plane predicts how each tile is distorted,
and one unknown is left: how far off it is, along the line on which the camera's motion lets it move. Direct
alignment in a region ahead of the vehicle is how Song and Chandraker (Robust scale estimation in real-time
monocular SFM, 2014) measure the height over the road; tiles leave it to `floor_scale.py` which of them are
floor.
"""

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
"""Of a tile. Flat, as a square piece of floor ahead is in the image."""
ABREAST = 1.0
"""Tiles lie this many heights of the camera to either side of it: what a vehicle drives on, no verge."""
MOST = 48
"""Tiles of a pair of images, those with most texture. Chosen: the time of a pair grows with them."""
MARGIN_PX = 4
"""Tiles keep this distance from the image's border and from the horizon: they move between two images."""
BLUR_PX = 0.8
"""Standard deviation of the blur before tiles are compared, px."""
SEARCHED = np.arange(-0.3, 0.31, 0.05)
"""Logarithms of inverse depth over the floor's with which a tile is tried first,"""
EVERY_OTHER = slice(None, None, 2)
"""of its pixels,"""
STEPS = 3
"""and Gauss-Newton steps from the best."""
CONVERGED = 0.02
"""Last step at most."""
LEAST_CORRELATION = 0.85
"""Of a tile with where it is found."""
STEP = 0.02
"""Of the numeric derivative by a logarithm."""
INDEPENDENT = 0.25
"""Share of a tile's pixels that count: blur makes neighbours alike."""
LEAST_SIGMA_PX = 0.1
"""Interpolation and lens."""


class FloorTiles:
    """Where tiles of the floor can lie in the images of one camera.

    Attributes:
        camera: intrinsics of the images.
        lens: of them.
        distorted: whether the lens moves any tile.
        top: first row of an image that matters.
    """

    def __init__(self, camera: Camera, lens: Lens) -> None:
        """Take the camera of the images, and their lens."""
        self.camera, self.lens = camera, lens
        self.top = max(math.floor(camera.cy), 0)
        rows = np.arange(self.top + MARGIN_PX, camera.height - MARGIN_PX - HEIGHT_PX, HEIGHT_PX)
        columns = np.arange(MARGIN_PX, camera.width - MARGIN_PX - WIDTH_PX, WIDTH_PX)
        corner = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
        y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
        pixels = corner + np.stack([x, y], axis=-1).reshape(1, -1, 2)
        raw = pixels.reshape(-1, 2).astype(np.float64)
        ideal = lens.undistort(raw)
        self.distorted = not np.array_equal(raw, ideal)
        # Row by row in a part of an image, of all pixels of all tiles.
        self._places = pixels[..., 0] + (pixels[..., 1] - self.top) * camera.width
        rays = np.ones((3, *self._places.shape))
        rays[:2] = ((ideal - [camera.cx, camera.cy]) / [camera.fx, camera.fy]).T.reshape(2, *rays.shape[1:])
        self._rays, self._middle = rays, np.ascontiguousarray(rays.mean(axis=2).T)

    def part(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """What matters of an image, (H, W) grey: below the middle row, a little blurred."""
        below = image[self.top :].astype(np.float32)
        if not below.size:
            return below
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
        middle = self._middle
        steepness = middle @ (at.floor / np.linalg.norm(at.floor))
        ahead = (steepness > FLOOR_STEEPNESS) & (np.abs(middle[:, 0]) < ABREAST * steepness)
        chosen = np.flatnonzero(ahead)
        size = (self.camera.height - self.top, self.camera.width)
        if not before.shape == after.shape == size or not len(chosen):
            return FloorMatches.none()
        template = before.ravel().take(self._places[chosen])
        # Texture along the way counts: gradients down the image.
        energy = np.square(np.diff(template.reshape(-1, HEIGHT_PX, WIDTH_PX), axis=1)).sum((1, 2))
        best = np.sort(np.argsort(-energy, kind="stable")[:MOST])
        chosen, template = chosen[best], template[best]
        rays = self._rays[:, chosen]
        warp = _Warp(self, rays, at)
        template = (template - template.mean(axis=1, keepdims=True)).astype(np.float64)
        logs = _searched(template, after, _Warp(self, rays[..., EVERY_OTHER], at))
        step = sigma = np.zeros(len(logs))
        for _ in range(STEPS):
            nearer, farther = warp.values(after, logs + np.array([[STEP], [-STEP]]))
            shown, slope = 0.5 * (nearer + farther), (nearer - farther) / (2.0 * STEP)
            gain = (_dot(template, shown) / np.maximum(_dot(shown, shown), 1e-6))[:, None]
            error, slope = gain * shown - template, gain * slope
            stiffness = _dot(slope, slope) + 1e-6
            step = np.clip(-_dot(slope, error) / stiffness, -0.05, 0.05)
            logs = np.clip(logs + step, -1.0, 1.0)
            sigma = np.sqrt(_dot(error, error) / (INDEPENDENT * error.shape[1] * stiffness))
        sigma = np.minimum(sigma, 1.0)
        column, row = warp.pixels(logs)
        inside = ((column > 2) & (column < self.camera.width - 3)).all(axis=1)
        inside &= ((row > self.top + 2) & (row < self.camera.height - 3)).all(axis=1)
        kept = inside & (np.abs(step) < CONVERGED)
        kept &= _correlation(template, warp.values(after, logs)) > LEAST_CORRELATION
        moved = warp.middle(logs + 0.5 * sigma) - warp.middle(logs - 0.5 * sigma)
        across = np.hypot(np.linalg.norm(moved, axis=1), LEAST_SIGMA_PX / self.camera.fy)
        return FloorMatches(middle[chosen][kept, :2], warp.middle(logs)[kept], across[kept])


class _Warp:
    """Where pixels of tiles are in the second image, by the logarithms of their inverse depths."""

    def __init__(self, tiles: FloorTiles, rays: Array, at: CameraMotions) -> None:
        """Take (3, N, P) rays of the tiles' pixels."""
        self._tiles = tiles
        flat = rays.reshape(3, -1)
        self._turned = (at.rotation @ flat).reshape(rays.shape)
        self._floor = (at.floor @ flat).reshape(rays.shape[1:])
        self._translation = at.translation

    def pixels(self, logs: Array) -> tuple[Array, Array]:
        """Columns and rows (..., N, P) px in the real image, by logarithms (..., N)."""
        tiles, camera = self._tiles, self._tiles.camera
        rho = self._floor * np.exp(logs)[..., None]
        x, y, z = (np.multiply(rho, t) for t in self._translation)
        for moved, turned in zip((x, y, z), self._turned, strict=True):
            moved += turned
        focal = np.divide(1.0, np.maximum(z, 0.05, out=z), out=z)
        for moved, length, centre in ((x, camera.fx, camera.cx), (y, camera.fy, camera.cy)):
            moved *= focal
            moved *= length
            moved += centre
        if tiles.distorted:
            there = tiles.lens.distort(np.column_stack([x.ravel(), y.ravel()]))
            x, y = there.T.reshape(2, *x.shape)
        return x, y

    def middle(self, logs: Array) -> Array:
        """(N, 2) normalised coordinates of the tiles' middles."""
        turned, floor = self._turned.mean(axis=2), self._floor.mean(axis=1)
        y = turned.T + (floor * np.exp(logs))[:, None] * self._translation
        return np.asarray(y[:, :2] / np.maximum(y[:, 2:], 0.05))

    def values(self, after: NDArray[np.float32], logs: Array) -> Array:
        """(..., N, P) of the second image there, less each tile's mean."""
        column, row = self.pixels(logs)
        row -= self._tiles.top
        # OpenCV takes two dimensions.
        x, y = (at.reshape(-1, at.shape[-1]).astype(np.float32) for at in (column, row))
        values = cv2.remap(after, x, y, cv2.INTER_LINEAR).reshape(column.shape)
        return np.asarray(values - values.mean(axis=-1, keepdims=True), np.float64)


def _dot(one: Array, other: Array) -> Array:
    """(..., N) products of rows (..., N, P)."""
    return np.asarray(np.einsum("...p,...p->...", one, other))


def _correlation(one: Array, other: Array) -> Array:
    """(N,) of rows that have no mean."""
    size = np.sqrt(_dot(one, one) * _dot(other, other))
    return np.asarray(_dot(one, other) / np.maximum(size, 1e-6))


def _searched(template: Array, after: NDArray[np.float32], warp: _Warp) -> Array:
    """(N,) best of the logarithms that are tried, by every other pixel: a warp of these."""
    part = np.ascontiguousarray(template[:, EVERY_OTHER])
    logs = np.repeat(SEARCHED[:, None], len(part), axis=1)
    return np.asarray(SEARCHED[_correlation(part, warp.values(after, logs)).argmax(axis=0)])
