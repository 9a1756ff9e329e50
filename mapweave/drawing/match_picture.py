"""A picture of a relocalization: the node's landmarks next to the query image.

A node keeps no image, only landmarks. They are drawn where its camera saw them, coloured by depth, and joined
to the features of the image that match them: green where the pose that was answered puts them within a few
pixels, red where it does not. Crosses in the image are all landmarks where that pose puts them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from mapweave.registration.matching import match
from mapweave.vision.lens import Lens

AGREES_PX = 5.0
"""A match agrees if its landmark lies so near to the feature by the pose that was answered."""
LEAST_HEIGHT = 480
"""Smaller images are drawn larger, px."""
BAND, GAP, WIDE = 28, 12, 1.8
"""Height of a caption and space between images, px; images wider than that share of their height are wide."""
GREEN, RED, CROSS, PAPER, WORDS = (90, 190, 60), (60, 60, 230), (230, 170, 40), (32, 28, 26), (235, 235, 235)


@dataclass(frozen=True, eq=False)
class Overlay:
    """What is drawn.

    Attributes:
        pairs: (M, 2) landmark of the node, feature of the view: all mutual matches.
        agreeing: (M,) those that the pose explains.
        predicted: (N, 2) px in the ideal image, where the node's landmarks should be; NaN where unknown.
    """

    pairs: NDArray[np.int64]
    agreeing: NDArray[np.bool_]
    predicted: NDArray[np.float64]

    @classmethod
    def of(cls, node: Node, view: View, node_from_robot: Pose2) -> Overlay:
        """Matches of a view with a node, judged by the pose of the view."""
        pairs = match(node.landmarks.codes, view.codes)
        points = node_from_robot.inverse().apply(node.points_in_robot)
        predicted = view.camera.project(points)
        off = np.linalg.norm(predicted[pairs[:, 0]] - view.pixels[pairs[:, 1]], axis=1)
        with np.errstate(invalid="ignore"):
            return cls(pairs, off <= AGREES_PX, predicted)


def draw_matches(
    path: Path, image: NDArray[np.uint8], lens: Lens, node: Node, view: View, node_from_robot: Pose2
) -> Overlay:
    """Draw a picture.

    Args:
        path: of the PNG.
        image: (H, W) grey, that was asked about.
        lens: of its camera.
        node: that was recognised.
        view: the image's features.
        node_from_robot: the pose that was answered.

    Raises:
        DeviceError: it cannot be written.
    """
    overlay = Overlay.of(node, view, node_from_robot)
    scale = max(LEAST_HEIGHT / min(image.shape[0], node.camera.height), 1.0)
    size = round(scale * node.camera.width), round(scale * node.camera.height)
    photo = cv2.resize(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), None, fx=scale, fy=scale)
    # Wide images are stacked.
    apart = np.array([0, size[1] + BAND] if size[0] > WIDE * size[1] else [size[0] + GAP, 0])
    below = np.array([0, BAND])
    corner = apart + below
    ends = np.maximum(np.array(size) + below, corner + photo.shape[1::-1])
    picture = np.full((ends[1], ends[0], 3), PAPER, np.uint8)
    picture[corner[1] : corner[1] + photo.shape[0], corner[0] : corner[0] + photo.shape[1]] = photo
    cv2.rectangle(picture, (0, BAND), (size[0] - 1, BAND + size[1] - 1), CROSS, 1)
    node_pixels = scale * (node.landmarks.pixels + 0.5) + below
    view_pixels = scale * (lens.distort(view.pixels) + 0.5) + corner
    inside = view.camera.contains(overlay.predicted)
    for x, y in scale * (lens.distort(overlay.predicted[inside]) + 0.5) + corner:
        cv2.drawMarker(picture, _at(x, y), CROSS, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
    for good in (False, True):
        for a, b in overlay.pairs[overlay.agreeing == good]:
            colour = GREEN if good else RED
            cv2.line(picture, _at(*node_pixels[a]), _at(*view_pixels[b]), colour, 1, cv2.LINE_AA)
            cv2.circle(picture, _at(*view_pixels[b]), 4, colour, 1, cv2.LINE_AA)
    for (x, y), colour in zip(node_pixels, _by_depth(node.landmarks.depths), strict=True):
        cv2.circle(picture, _at(x, y), 4, colour, -1, cv2.LINE_AA)
    agreeing, matched = int(overlay.agreeing.sum()), len(overlay.pairs)
    _write(picture, (0, 0), f"node {node.id}: {len(node.landmarks)} landmarks, near yellow, far violet")
    _write(
        picture, apart, f"{agreeing} of {matched} matches agree (green); crosses: where landmarks should be"
    )
    if not cv2.imwrite(str(path), picture):
        raise DeviceError(f"{path}: the picture cannot be written; end its name with .png")
    return overlay


def _by_depth(depths: NDArray[np.float32]) -> list[tuple[int, int, int]]:
    """Colours, by the logarithm of depth; grey where it is unknown."""
    has_depth = np.isfinite(depths)
    colours = np.full((len(depths), 3), 150, np.uint8)
    if has_depth.any():
        logs = np.log(depths[has_depth])
        share = (logs - logs.min()) / max(float(np.ptp(logs)), 1e-6)
        levels = np.rint(255.0 * (1.0 - 0.75 * share)).astype(np.uint8)
        colours[has_depth] = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_PLASMA)[:, 0]
    return [(int(b), int(g), int(r)) for b, g, r in colours]


def _write(picture: NDArray[Any], corner: tuple[int, int] | NDArray[np.int64], words: str) -> None:
    at = int(corner[0]) + 8, int(corner[1]) + BAND - 9
    cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, WORDS, 1, cv2.LINE_AA)


def _at(x: float, y: float) -> tuple[int, int]:
    return round(float(x)), round(float(y))
