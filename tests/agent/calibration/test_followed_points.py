"""Points that calibration follows: none on edges, and none that follow the light."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mapweave.agent.calibration.floor_points import FloorPoints
from mapweave.agent.calibration.image_pairs import corners
from synthetic.room_drive import CAMERA


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


@pytest.mark.parametrize("gain", [0.85, 1.0, 1.15])
def test_a_floor_of_little_texture_is_followed_while_the_light_changes(gain: float):
    """The camera's gain follows the light, and its lens is darker at the border."""
    rng = np.random.default_rng(0)
    shape = (CAMERA.height, CAMERA.width)
    pattern = cv2.GaussianBlur(rng.normal(0.0, 12.0, shape), (0, 0), 1.5)
    y, x = np.mgrid[: shape[0], : shape[1]]
    shade = 1.0 - 0.4 * (((x - CAMERA.cx) / 160.0) ** 2 + ((y - CAMERA.cy) / 120.0) ** 2) / 2.0
    images = []
    for way, light in ((0.0, 1.0), (3.3, gain)):
        moved = cv2.warpAffine(pattern, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, way]]), shape[::-1])
        images.append(np.clip(light * shade * (120.0 + moved) + rng.normal(0.0, 0.5, shape), 0, 255))
    points = FloorPoints(CAMERA)
    points.start(images[0].astype(np.uint8))
    points.follow(images[1].astype(np.uint8))
    begin, end = points.moved
    assert len(begin) > 30
    assert np.median(end - begin, axis=0) == pytest.approx([0.0, 3.3], abs=0.1)
