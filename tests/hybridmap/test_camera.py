"""The pinhole camera: projection and back projection undo each other."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.node import Landmarks

CAMERA = Camera(320, 240, 280.0, 270.0, 161.0, 118.0, mount_height=0.3, mount_forward=0.1)


@given(st.floats(0, 319), st.floats(0, 239), st.floats(0.1, 50))
def test_back_projection_projects_to_the_pixel(u: float, v: float, depth: float):
    point = CAMERA.back_project(np.array([u, v]), np.array(depth))
    assert np.allclose(CAMERA.project(point), [u, v], atol=1e-6)
    assert point[0] == pytest.approx(depth + CAMERA.mount_forward)


def test_left_is_left_and_up_is_up():
    u, v = CAMERA.project(np.array([2.0, 0.5, 0.8]))
    assert u < CAMERA.cx and v < CAMERA.cy
    assert CAMERA.bearings(np.array([u, v])) == pytest.approx(math.atan2(0.5, 2.0 - 0.1))


def test_points_behind_have_no_pixel():
    assert np.isnan(CAMERA.project(np.array([[0.1, 0, 0], [-1, 0, 0]]))).all()
    assert not CAMERA.contains(CAMERA.project(np.array([[-1.0, 0, 0]]))).any()


def test_contains_keeps_its_margin():
    pixels = np.array([[0, 0], [319, 239], [4, 100], [320, 100]])
    assert CAMERA.contains(pixels).tolist() == [True, True, True, False]
    assert CAMERA.contains(pixels, margin_px=4).tolist() == [False, False, True, False]


def test_semi_aperture_is_the_narrower_side():
    assert CAMERA.semi_aperture == pytest.approx(math.atan(159 / 280))


@pytest.mark.parametrize(
    "wrong", [{"fx": 0.0}, {"width": 5}, {"height": 99999}, {"cx": math.nan}, {"mount_height": math.inf}]
)
def test_impossible_cameras_are_refused(wrong: dict[str, float]):
    good = {"width": 320, "height": 240, "fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0, "mount_height": 0.2}
    with pytest.raises(InvalidValue):
        Camera(**{**good, **wrong})  # type: ignore[arg-type]


def test_landmark_covariances_against_sampling():
    rng = np.random.default_rng(1)
    pixel, depth, depth_sigma, pixel_sigma = np.array([70.0, 200.0]), 3.0, 0.05, 0.8
    landmarks = Landmarks(
        pixel[None].astype(np.float32),
        np.zeros((1, 32), np.uint8),
        np.array([depth], np.float32),
        np.array([depth_sigma], np.float32),
    )
    n = 60_000
    points = CAMERA.back_project(
        pixel + rng.normal(0, pixel_sigma, (n, 2)), depth + rng.normal(0, depth_sigma, n)
    )
    expected = landmarks.covariances_in_robot(CAMERA, pixel_sigma)[0]
    assert np.allclose(np.cov(points.T), expected, rtol=0.05, atol=2e-6)
