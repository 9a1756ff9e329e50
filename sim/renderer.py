"""Renders textured panels for an ideal pinhole camera.

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

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array
from mapweave.sim.scene import Scene, cross
from mapweave.sim.texture import Image, Texture
from mapweave.sim.warp import warped
from mapweave.sim.world import PanelSet

NEAR = 0.03
"""Nothing nearer than this along the optical axis is drawn, m."""

FAR = 60.0
"""Nothing farther than this is drawn, m."""

CHUNK = 16
"""So many panels are measured at once, nearest first; what is hidden by then is not measured at all."""

CAMERA_FROM_ROBOT = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""(3, 3) turns robot vectors (x forward, y left, z up) into camera vectors (x right, y down, z forward)."""


class Renderer:
    """Renders for one camera. Not thread-safe: it keeps its working memory."""

    def __init__(self, camera: Camera, background: int) -> None:
        """Prepare the pixel grid."""
        self.camera = camera
        self._background = background
        width, height = camera.width, camera.height
        intrinsics = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        self._intrinsics = intrinsics
        self._from_pixels = np.linalg.inv(intrinsics)
        self._columns = np.arange(width, dtype=np.float32)
        self._rows = np.arange(height, dtype=np.float64)
        self._robot_from_camera = np.array([camera.mount_forward, 0.0, camera.mount_height])
        # The borders of the picture as planes through the optical centre, (4, 3), inside positive.
        right, low = width - 0.5, height - 0.5
        borders = np.array([[1.0, 0.0, 0.5], [-1.0, 0.0, right], [0.0, 1.0, 0.5], [0.0, -1.0, low]])
        borders = borders @ intrinsics
        self._borders = borders / np.linalg.norm(borders, axis=1, keepdims=True)
        self._image_corners = np.array(
            [[-0.5, right, -0.5, right], [-0.5, -0.5, low, low], [1.0, 1.0, 1.0, 1.0]]
        )
        self._depth = np.zeros((height, width), np.float32)
        self._inverse = np.zeros((height, width), np.float32)
        self._mask = np.zeros((height, width), np.uint8)
        self._inside = np.zeros((height, width), np.bool_)

    def render(
        self, panels: PanelSet | Scene, rotation: NDArray[np.float64], position: NDArray[np.float64]
    ) -> Image:
        """Render.

        Args:
            panels: everything that can be seen, in world.
            rotation: (3, 3) turns robot vectors into world.
            position: (3,) m, the robot's origin in world.

        Returns:
            (H, W) grey.
        """
        scene = panels if isinstance(panels, Scene) else Scene([panels])
        image = np.full((self.camera.height, self.camera.width), self._background, np.uint8)
        self._depth.fill(0.0)
        candidates = self._in_view(scene, rotation, position)
        for start in range(0, len(candidates.index), CHUNK):
            # A panel hidden now stays hidden: depths only decrease.
            chosen = [
                k
                for k in range(start, min(start + CHUNK, len(candidates.index)))
                if start == 0 or not self._hidden(candidates.windows[k], candidates.nearest[k])
            ]
            if chosen:
                for drawn in self._measure(candidates, np.array(chosen)):
                    self._draw(image, scene.textures[drawn.index], drawn)
        return image

    def _in_view(self, scene: Scene, rotation: Array, position: Array) -> _Candidates:
        """Panels that face the camera and may meet the image, nearest first."""
        camera_from_world = CAMERA_FROM_ROBOT @ rotation.T
        optical_centre = position + rotation @ self._robot_from_camera
        # First by bounding spheres: most panels of a building are outside the view.
        middles = (scene.middle - optical_centre) @ camera_from_world.T
        distances, ahead = middles @ self._borders.T, middles[:, 2]
        inside = (distances > -scene.radius[:, None]).all(axis=1)
        inside &= (ahead > NEAR - scene.radius) & (ahead < FAR + scene.radius)
        index = np.flatnonzero(inside)
        corner, normal = scene.corner[index] - optical_centre, scene.normal[index]
        offsets = np.einsum("ij,ij->i", normal, corner)
        front = offsets > 1e-12
        index, corner, normal, offsets = index[front], corner[front], normal[front], offsets[front]
        along, down = scene.along[index], scene.down[index]
        # A point corner + p along + q down is seen at (u, v, 1) / w by to_pixels; Cramer's rule inverts
        # that: p w, q w and w are linear forms of (u, v, 1), with w the inverse depth.
        rows = np.stack([cross(down, corner), cross(corner, along), normal], axis=1)
        forms = rows @ (camera_from_world.T @ self._from_pixels) / offsets[:, None, None]
        ends = np.stack([corner, corner + along, corner + down, corner + along + down], axis=1)
        shown = ends @ (self._intrinsics @ camera_from_world).T
        x, y, z = shown[..., 0], shown[..., 1], shown[..., 2]
        cut = np.asarray((z < NEAR).any(axis=1) | (z > FAR).any(axis=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = x / z, y / z
        width, height = self.camera.width, self.camera.height
        left, right = np.ceil(u.min(axis=1)), np.floor(u.max(axis=1))
        top, low = np.ceil(v.min(axis=1)), np.floor(v.max(axis=1))
        # The nearest point of the panel is a corner; that of its plane in the image, a corner of the image.
        by_plane = (forms[:, 2] @ self._image_corners).max(axis=1)
        with np.errstate(divide="ignore"):
            by_corners = np.where(cut, np.inf, 1.0 / z.min(axis=1))
        nearest: Array = np.minimum(np.minimum(by_plane, by_corners) * (1 + 1e-6), 1.0 / NEAR)
        left, top = np.where(cut, 0.0, np.maximum(left, 0.0)), np.where(cut, 0.0, np.maximum(top, 0.0))
        right = np.where(cut, width - 1.0, np.minimum(right, width - 1.0))
        low = np.where(cut, height - 1.0, np.minimum(low, height - 1.0))
        in_view = (left <= right) & (top <= low) & (z > NEAR).any(axis=1) & (nearest > 1 / FAR)
        visible = np.flatnonzero(in_view)
        order = visible[np.argsort(-nearest[visible], kind="stable")]
        bounds = np.stack([top, low + 1, left, right + 1], axis=1)[order].astype(int).tolist()
        windows = [(slice(b[0], b[1]), slice(b[2], b[3])) for b in bounds]
        return _Candidates(index[order], forms[order], windows, nearest[order].tolist(), cut[order])

    def _hidden(self, window: tuple[slice, slice], nearest: float) -> bool:
        """Whether all of a window shows something nearer already."""
        return bool(self._depth[window].min() >= nearest)

    def _measure(self, candidates: _Candidates, chosen: NDArray[np.intp]) -> list[_Drawn]:
        """Where exactly panels are in the image; those that meet no pixel are left out."""
        forms = candidates.forms[chosen]
        low, high = self._spans(forms, bool(candidates.cut[chosen].any()))
        filled = low <= high
        rows = filled.any(axis=1)
        first = filled.argmax(axis=1).tolist()
        last = (filled.shape[1] - filled[:, ::-1].argmax(axis=1)).tolist()
        left = np.where(filled, low, np.inf).min(axis=1)
        right = np.where(filled, high, -np.inf).max(axis=1)
        # Where a panel fills its window no pixel has to be asked whether it is inside.
        square = (~filled | ((low == left[:, None]) & (high == right[:, None]))).all(axis=1)
        indices = candidates.index[chosen].tolist()
        drawn = []
        for k in np.flatnonzero(rows).tolist():
            span = slice(first[k], last[k])
            window = (span, slice(int(left[k]), int(right[k]) + 1))
            edges = None if square[k] else (low[k, span, None], high[k, span, None])
            drawn.append(_Drawn(indices[k], forms[k], window, candidates.nearest[chosen[k]], edges))
        return drawn

    def _spans(self, forms: Array, cut: bool) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """First and last column of each panel in each row, (n, H) each; empty where first > last.

        Args:
            forms: (n, 3, 3).
            cut: whether a panel may come too near or go too far.
        """
        p, q, w = forms[:, 0], forms[:, 1], forms[:, 2]
        halves = [p, w - p, q, w - q]  # each must be >= 0 inside
        if cut:
            halves += [w - [0.0, 0.0, 1.0 / FAR], np.array([0.0, 0.0, 1.0 / NEAR]) - w]
        sides = np.stack(halves, axis=1)
        slope = sides[..., 0]
        # A level edge lets all of a row pass or nothing: its crossing is far out on one side.
        level = np.abs(slope) < 1e-12
        slope = np.where(level, 1e-12, slope)
        crossing = (-sides[..., 1] / slope)[..., None] * self._rows + (-sides[..., 2] / slope)[..., None]
        rising = (slope > 0)[..., None]
        low = np.where(rising, crossing, 0.0).max(axis=1)
        high = np.where(rising, self.camera.width - 1.0, crossing).min(axis=1)
        low, high = np.ceil(np.maximum(low, 0.0)), np.floor(high)
        # Beyond the image they shall still fit into short numbers.
        width = float(self.camera.width)
        return np.minimum(low, width).astype(np.float32), np.maximum(high, -1.0).astype(np.float32)

    def _draw(self, image: Image, texture: Texture, drawn: _Drawn) -> None:
        """Draw one panel where it is in front of all that was drawn before."""
        window = drawn.window
        behind = self._depth[window]
        if behind.min() >= drawn.nearest:
            return
        rows, columns = window
        size = (slice(0, rows.stop - rows.start), slice(0, columns.stop - columns.start))
        a, b, c = drawn.forms[2].tolist()
        down = (b * self._rows[rows] + c).astype(np.float32)[:, None]
        across = self._columns[columns]
        inverse, mask = self._inverse[size], self._mask[size]
        won = mask.view(np.bool_)
        np.add(down, np.float32(a) * across, out=inverse)
        np.greater(inverse, behind, out=won)
        if drawn.edges is not None:
            inside = self._inside[size]
            won &= np.greater_equal(across, drawn.edges[0], out=inside)
            won &= np.less_equal(across, drawn.edges[1], out=inside)
        left, top, width, height = cv2.boundingRect(mask)
        if not width:
            return
        cv2.copyTo(inverse, mask, behind)
        mask = mask[top : top + height, left : left + width]
        # Between two pixels of one row the panel, which is convex, is met for sure; at the middle it may not.
        row = mask[height // 2].nonzero()[0]
        if not len(row):
            row, centre_v = mask[0].nonzero()[0], top
        else:
            centre_v = top + height // 2
        left, top, centre_v = left + columns.start, top + rows.start, centre_v + rows.start
        centre_u = left + (int(row[0]) + int(row[-1])) / 2
        patch = warped(texture, drawn.forms, (centre_u, centre_v), (left, top, width, height))
        cv2.copyTo(patch, mask, image[top : top + height, left : left + width])


@dataclass(frozen=True, eq=False, slots=True)
class _Candidates:
    """Panels that may be in view, nearest first.

    Attributes:
        index: (n,) in the scene.
        forms: (n, 3, 3) rows p / z, q / z, 1 / z as linear forms of (u, v, 1).
        windows: n, outside of which they are not.
        nearest: n, inverse depth that they do not exceed in the image, 1/m.
        cut: (n,) whether a part is too near or too far.
    """

    index: NDArray[np.intp]
    forms: Array
    windows: list[tuple[slice, slice]]
    nearest: list[float]
    cut: NDArray[np.bool_]


@dataclass(frozen=True, eq=False, slots=True)
class _Drawn:
    """A panel that meets the image.

    Attributes:
        index: in the scene.
        forms: (3, 3) rows p / z, q / z, 1 / z as linear forms of (u, v, 1).
        window: rows and columns that it meets.
        nearest: inverse depth that it does not exceed, 1/m.
        edges: first and last column in each row of the window, (h, 1) each; None if it fills the window.
    """

    index: int
    forms: Array
    window: tuple[slice, slice]
    nearest: float
    edges: tuple[NDArray[np.float32], NDArray[np.float32]] | None
