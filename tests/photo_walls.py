"""Photographs on walls, as a camera sees them by exact homographies."""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import skimage.data

from mapweave import Camera, Pose2

Wall = tuple[np.ndarray, float, float, float, float]
"""A grey picture, and m in world: x of the wall, y of its left edge, z of its top edge, its width."""


@cache
def photograph(name: str) -> np.ndarray:
    """A grey picture of scikit-image, a little blurred."""
    grey = cv2.cvtColor(getattr(skimage.data, name)(), cv2.COLOR_RGB2GRAY)
    soft = cv2.GaussianBlur(grey, (0, 0), 1.0)
    soft.flags.writeable = False
    return soft


def two_walls() -> list[Wall]:
    """A far wall on the right and a near one on the left, facing a robot at the origin."""
    return [(photograph("coffee"), 3.2, 0.2, 1.5, 2.6), (photograph("astronaut"), 2.2, 1.9, 1.3, 1.8)]


def rendered(walls: Sequence[Wall], camera: Camera, world_from_robot: Pose2, empty: int = 128) -> np.ndarray:
    """(height, width) grey; a wall hides those before it in the list. Nothing is `empty`."""
    size = camera.width, camera.height
    image = np.full((camera.height, camera.width), empty, np.uint8)
    for picture, x, y, z, width in walls:
        height = width / picture.shape[1] * picture.shape[0]
        corners = np.array([[x, y, z], [x, y - width, z], [x, y - width, z - height], [x, y, z - height]])
        seen = camera.project(world_from_robot.inverse().apply(corners)).astype(np.float32)
        own = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (picture.shape[1], picture.shape[0]) - 0.5
        to_image = cv2.getPerspectiveTransform(own.astype(np.float32), seen)
        drawn = cv2.warpPerspective(picture, to_image, size, flags=cv2.INTER_AREA)
        mask = cv2.warpPerspective(np.full_like(picture, 255), to_image, size)
        np.copyto(image, drawn, where=mask > 127)
    return image
