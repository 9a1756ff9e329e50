"""Turn and way by two images, against images of a wall that are warped by the exact homography."""

import cv2
import numpy as np
import pytest

from mapweave.agent.vision.visual_odometry import visual_motion
from mapweave.hybridmap.camera import Camera

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
DEPTH = 2.0
"""m, of the wall."""


def moved(image: np.ndarray, turn: float, way: float) -> np.ndarray:
    """The wall after the camera has driven ahead, m, and turned to the left, rad."""
    k = np.array([[CAMERA.fx, 0.0, CAMERA.cx], [0.0, CAMERA.fy, CAMERA.cy], [0.0, 0.0, 1.0]])
    c, s = np.cos(turn), np.sin(turn)
    # A point of the wall is (x, y, 1) DEPTH; what is on the right of a robot that turns left moves right.
    second_from_first = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    closer = np.diag([1.0, 1.0, 1.0 - way / DEPTH])
    homography = k @ second_from_first @ closer @ np.linalg.inv(k)
    return cv2.warpPerspective(image, homography, (320, 240), borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize("width", [320, 160])
@pytest.mark.parametrize(("turn", "way"), [(0.06, 0.0), (-0.04, 0.0), (0.0, 0.06), (0.03, -0.05)])
def test_motion_is_that_of_the_wall_also_by_reduced_images(width: int, turn: float, way: float):
    noise = np.random.default_rng(3).uniform(0.0, 255.0, (240, 320))
    blurred = cv2.GaussianBlur(noise, (0, 0), 3.0)
    first = cv2.normalize(blurred, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    size = (width, width * 3 // 4)
    images = [cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (first, moved(first, turn, way))]
    motion = visual_motion(images[0], images[1], CAMERA)
    assert motion is not None
    assert motion.turn == pytest.approx(turn, abs=0.003)
    assert motion.expansion == pytest.approx(way / DEPTH, abs=0.004)
