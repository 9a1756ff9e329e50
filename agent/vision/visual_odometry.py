"""How a robot has turned and driven between two images, by optical flow alone: no wheels, no map.

A camera that faces ahead sees a turn psi (to the left) and a way t as a flow of slopes x (right), y (down)

    dx = psi (1 + x^2) + x s        dy = psi x y + y s

with s = t / Z, the way over the depth, taken as one for the whole image (Longuet-Higgins and Prazdny 1980).
The turn is exact to first order; the sign of s says whether the robot has driven forward.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import median
from mapweave.hybridmap.camera import Camera

WINDOW_PX = (15, 15)
"""Patch that is followed, px."""
POINTS = 100
"""Corners that are followed."""
LEAST_POINTS = 12
"""With fewer nothing is said. Chosen: a turn needs two, the others are for outliers."""
WIDTH_PX = 160
"""Images are reduced to this width: turns need no more, and it takes a quarter of the time of 320 px."""
ROUNDS = 4
"""Of least squares, each with the points that the one before fits worst weighed down."""


class VisualMotion(NamedTuple):
    """Between two images.

    Attributes:
        turn: rad, to the left.
        expansion: way over depth; positive forward.
    """

    turn: float
    expansion: float


def visual_motion(before: NDArray[np.uint8], now: NDArray[np.uint8], camera: Camera) -> VisualMotion | None:
    """Compare two grey images (H, W) of a camera, both possibly reduced; None if they show too little."""
    start = cv2.goodFeaturesToTrack(before, POINTS, 0.01, 7)
    if start is None or len(start) < LEAST_POINTS:
        return None
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, now, start, start.copy(), winSize=WINDOW_PX, maxLevel=4
    )
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        now, before, there, there.copy(), winSize=WINDOW_PX, maxLevel=4
    )
    good = (found[:, 0] == 1) & (found_back[:, 0] == 1) & (np.linalg.norm(back - start, axis=2)[:, 0] < 1.0)
    if good.sum() < LEAST_POINTS:
        return None
    reduced = np.array(before.shape[::-1]) / (camera.width, camera.height)
    middle = (np.array([camera.cx, camera.cy]) + 0.5) * reduced - 0.5
    focal = np.array([camera.fx, camera.fy]) * reduced
    first = (start[good, 0].astype(np.float64) - middle) / focal
    flow = (there[good, 0].astype(np.float64) - middle) / focal - first
    x, y = first.T
    jacobian = np.stack([np.stack([1.0 + x**2, x], axis=1), np.stack([x * y, y], axis=1)], axis=1)
    weights, solution = np.ones(len(first)), np.zeros(2)
    for _ in range(ROUNDS):
        weighted = jacobian * weights[:, None, None]
        normal = np.einsum("nki,nkj->ij", weighted, jacobian)
        solution = np.linalg.solve(normal + 1e-9 * np.eye(2), np.einsum("nki,nk->i", weighted, flow))
        miss = np.linalg.norm(flow - jacobian @ solution, axis=1)
        spread = max(median(miss), 1e-5)
        weights = 1.0 / (1.0 + (miss / (2.0 * spread)) ** 2)
    return VisualMotion(float(solution[0]), float(solution[1]))


def reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A grey image (H, W), at most WIDTH_PX wide."""
    height, width = image.shape
    if width <= WIDTH_PX:
        return image
    size = (WIDTH_PX, max(round(height * WIDTH_PX / width), 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
