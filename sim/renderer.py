"""Draws textured panels as an ideal pinhole camera sees them.

Every surface is flat, so each is one homography away from the image and its inverse depth is linear in
the pixel. That makes an exact renderer of a few numpy and OpenCV calls, which filters textures properly:
PyBullet's TinyRenderer samples the nearest texel, so that distant walls shimmer, and takes several times
as long: docs/decisions/renderer.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.pose import Array
from sim.texture import Image, Texture
from sim.world import PanelSet

NEAR = 0.03
"""Nothing nearer than this along the optical axis is drawn, m."""

FAR = 60.0
"""Nothing farther than this is drawn, m."""

CAMERA_FROM_ROBOT = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""(3, 3) turns robot vectors (x forward, y left, z up) into camera vectors (x right, y down, z forward)."""


class Renderer:
    """Draws one world for one kind of camera."""

    def __init__(self, camera: Camera, background: int) -> None:
        """Prepare the pixel grid.

        Args:
            camera: intrinsics and mount.
            background: grey where nothing is.
        """
        self.camera = camera
        self._background = background
        self._intrinsics = np.array(
            [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        )
        self._columns = np.arange(camera.width, dtype=np.float32)
        self._rows = np.arange(camera.height, dtype=np.float64)
        self._robot_from_camera = np.array([camera.mount_forward, 0.0, camera.mount_height])

    def render(self, panels: PanelSet, rotation: NDArray[np.float64], position: NDArray[np.float64]) -> Image:
        """Draw.

        Args:
            panels: everything that can be seen, in world.
            rotation: (3, 3) turns robot vectors into world.
            position: (3,) m, the robot's origin in world.

        Returns:
            (H, W) grey.
        """
        image = np.full((self.camera.height, self.camera.width), self._background, np.uint8)
        drawn = self._in_view(panels, rotation, position)
        if len(drawn.index) == 0:
            return image
        numbers, windows = self._visible(drawn)
        for number, window in windows.items():
            mask = numbers[window] == number
            if mask.any():
                texture = panels.textures[drawn.index[number]]
                self._paint(image, window, mask, texture, drawn.forms[number])
        return image

    def _in_view(self, panels: PanelSet, rotation: Array, position: Array) -> _Drawn:
        """Panels that face the camera and meet the image, nearest first."""
        camera_from_world = CAMERA_FROM_ROBOT @ rotation.T
        optical_centre = position + rotation @ self._robot_from_camera
        to_pixels = self._intrinsics @ camera_from_world
        # Columns of (p, q, 1) -> z * (u, v, 1), where a point of the panel is corner + p along + q down.
        maps = np.stack(
            [
                panels.along @ to_pixels.T,
                panels.down @ to_pixels.T,
                (panels.corner - optical_centre) @ to_pixels.T,
            ],
            axis=-1,
        )
        corners = maps @ np.array([[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0]])
        x, y, z = corners[:, 0], corners[:, 1], corners[:, 2]
        width, height = self.camera.width, self.camera.height
        facing = np.linalg.det(maps) > 1e-9
        outside = (
            (z < NEAR).all(axis=1)
            | (x < -0.5 * z).all(axis=1)
            | (x > (width - 0.5) * z).all(axis=1)
            | (y < -0.5 * z).all(axis=1)
            | (y > (height - 0.5) * z).all(axis=1)
        )
        index = np.flatnonzero(facing & ~outside)
        # Rows of the inverse give p / z, q / z and 1 / z as linear forms of (u, v, 1).
        forms = np.linalg.inv(maps[index])
        low, high = self._spans(forms)
        nearest = self._nearest(forms, low, high)
        order = np.argsort(-nearest, kind="stable")
        filled = np.asarray((low <= high).any(axis=1))
        order = order[filled[order]]
        return _Drawn(index[order], forms[order], low[order], high[order], nearest[order])

    def _spans(self, forms: Array) -> tuple[Array, Array]:
        """First and last column of each panel in each row, (n, H) each; empty where first > last."""
        p, q, w = forms[:, 0], forms[:, 1], forms[:, 2]
        beyond = w - [0.0, 0.0, 1.0 / FAR]
        before = np.array([0.0, 0.0, 1.0 / NEAR]) - w
        halves = np.stack([p, w - p, q, w - q, beyond, before], axis=1)  # each must be >= 0 inside
        slope = halves[..., 0, None]
        rest = halves[..., 1, None] * self._rows + halves[..., 2, None]
        level = np.abs(slope) < 1e-12
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -rest / slope
        low = np.where(slope > 0, crossing, -np.inf)
        high = np.where(slope < 0, crossing, np.inf)
        low = np.where(level, np.where(rest >= 0, -np.inf, np.inf), low).max(axis=1)
        high = np.where(level, np.inf, high).min(axis=1)
        return np.maximum(np.ceil(low), 0.0), np.minimum(np.floor(high), self.camera.width - 1.0)

    def _nearest(self, forms: Array, low: Array, high: Array) -> Array:
        """(n,) the largest inverse depth that each panel reaches in the image, 1/m."""
        a, b, c = forms[:, 2].T[..., None]
        at_rows = b * self._rows + c
        filled = low <= high
        with np.errstate(invalid="ignore"):
            ends = np.maximum(a * low, a * high) + at_rows
        nearest: Array = np.where(filled, ends, 0.0).max(axis=1, initial=0.0)
        return nearest

    def _visible(self, drawn: _Drawn) -> tuple[NDArray[np.int16], dict[int, tuple[slice, slice]]]:
        """Which panel is in front at each pixel, and the window of each panel that may be."""
        depth = np.zeros((self.camera.height, self.camera.width), np.float32)
        numbers = np.full(depth.shape, -1, np.int16)
        windows: dict[int, tuple[slice, slice]] = {}
        for number in range(len(drawn.index)):
            low, high = drawn.low[number], drawn.high[number]
            rows = np.flatnonzero(low <= high)
            span = slice(int(rows[0]), int(rows[-1]) + 1)
            low, high = low[span].astype(np.float32), high[span].astype(np.float32)
            across = slice(int(low[rows - rows[0]].min()), int(high[rows - rows[0]].max()) + 1)
            window = (span, across)
            behind = depth[window]
            if behind.min() >= drawn.nearest[number]:
                continue
            a, b, c = drawn.forms[number, 2]
            columns = self._columns[across]
            inverse = (b * self._rows[span] + c).astype(np.float32)[:, None] + np.float32(a) * columns
            mask = inverse > behind
            mask &= columns >= low[:, None]
            mask &= columns <= high[:, None]
            np.copyto(behind, inverse, where=mask)
            numbers[window][mask] = number
            windows[number] = window
        return numbers, windows

    def _paint(
        self,
        image: Image,
        window: tuple[slice, slice],
        mask: NDArray[np.bool_],
        texture: Texture,
        forms: Array,
    ) -> None:
        """Draw one panel where it is in front, filtered for its size in the image."""
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        top, left = int(rows[0]), int(columns[0])
        height, width = int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left
        middle = int(rows[len(rows) // 2])
        # A mean of pixels of one row lies on the panel, which is convex; the window's centre may not.
        centre = np.array(
            [window[1].start + np.flatnonzero(mask[middle]).mean(), window[0].start + middle, 1.0]
        )
        mask = mask[top : top + height, left : left + width]
        top, left = top + window[0].start, left + window[1].start
        p, q, w = forms @ centre
        across = np.hypot(*(forms[0, :2] - p / w * forms[2, :2])) / abs(w) * texture.width_px
        down = np.hypot(*(forms[1, :2] - q / w * forms[2, :2])) / abs(w) * texture.height_px
        source = texture.level(_halvings(across, texture.width_px), _halvings(down, texture.height_px))
        to_texture = np.diag([source.shape[1], source.shape[0], 1.0])
        to_texture[:2, 2] = -0.5  # pixel centres are whole numbers, OpenCV's convention
        shift = np.array([[1.0, 0.0, left], [0.0, 1.0, top], [0.0, 0.0, 1.0]])
        patch = cv2.warpPerspective(
            source,
            to_texture @ forms @ shift,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        np.copyto(image[top : top + height, left : left + width], patch, where=mask)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Panels in view, nearest first.

    Attributes:
        index: (n,) in the panel set.
        forms: (n, 3, 3) rows p / z, q / z, 1 / z as linear forms of (u, v, 1).
        low: (n, H) first column in each row.
        high: (n, H) last column in each row.
        nearest: (n,) largest inverse depth, 1/m.
    """

    index: NDArray[np.intp]
    forms: Array
    low: Array
    high: Array
    nearest: Array


def _halvings(texels_per_pixel: float, size_px: int) -> int:
    """How often to halve a texture so that about one texel falls on one pixel."""
    wanted = round(float(np.log2(max(texels_per_pixel, 1.0))))
    return min(wanted, size_px.bit_length() - 1)
