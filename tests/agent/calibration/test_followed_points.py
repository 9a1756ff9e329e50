"""Points that calibration follows: none on edges."""

import cv2
import numpy as np

from mapweave.agent.calibration.image_pairs import corners
from tests.agent.calibration.room_drive import CAMERA


def test_points_on_an_edge_are_not_followed():
    """The stairs of an edge that is not smoothed look like corners, and slide along it."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    image = np.where(y > 120 + 0.08 * x, 60, 160).astype(np.uint8)
    image[30:50, 100:120] = 20
    stairs = cv2.goodFeaturesToTrack(image, 60, 0.005, 7)[:, 0]
    assert (stairs[:, 1] > 100).any()
    found = corners(image, 60, 0.005, 7, 13)
    assert len(found) == 4
    assert (np.abs(found - [109.5, 39.5]).max(axis=1) < 14).all()
