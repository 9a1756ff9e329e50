"""Fisheye lenses against OpenCV's, finite differences, and themselves back and forth."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.vision.equidistant import WIDEST, Equidistant
from mapweave.vision.lens import Lens, LensModel, lens_of
from mapweave.vision.sift import Sift

REAL = Camera(320, 240, 115.0, 115.4, 158.6, 120.9, mount_height=0.3, mount_forward=0.1)
K = (-0.02, 0.004, -0.003, 0.0005)

coefficients = st.tuples(*[st.floats(-0.08, 0.08)] * 2, *[st.floats(-0.01, 0.01)] * 2)
angles = st.lists(
    st.tuples(st.floats(0.0, math.radians(75)), st.floats(-math.pi, math.pi)), min_size=1, max_size=20
)


def fisheye(k: tuple[float, ...]) -> Equidistant:
    try:
        return Equidistant(REAL.fx, REAL.fy, REAL.cx, REAL.cy, k)
    except InvalidValue:
        assume(False)
        raise


def tangents(angles: list[tuple[float, float]]) -> np.ndarray:
    return np.array([[math.tan(a) * math.cos(b), math.tan(a) * math.sin(b)] for a, b in angles])


@given(coefficients, angles)
def test_points_are_where_opencv_sees_them(k, angles):
    lens, rays = fisheye(k), tangents(angles)
    matrix = np.array([[REAL.fx, 0, REAL.cx], [0, REAL.fy, REAL.cy], [0, 0, 1]])
    points = np.column_stack([rays, np.ones(len(rays))])[:, None]
    expected, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(k))
    assert np.allclose(lens.project(rays), expected.reshape(-1, 2), atol=1e-6)


@given(coefficients, angles)
def test_rays_come_back(k, angles):
    lens, rays = fisheye(k), tangents([(min(a, WIDEST), b) for a, b in angles])
    back = lens.rays(lens.project(rays))
    assert np.allclose(back, rays, atol=1e-7)


@given(coefficients)
def test_angles_beyond_a_fold_have_no_ray(k):
    lens = fisheye(k)
    rays = lens.rays(np.column_stack([np.linspace(-400.0, 700.0, 200), np.full(200, REAL.cy)]))
    known = rays[np.isfinite(rays[:, 0]), 0]
    assert (np.diff(known) > 0).all(), "a pixel further right shows a ray further right"
    assert np.abs(known).max() <= math.tan(math.radians(80)) + 1e-6


def test_lenses_that_fold_are_refused():
    with pytest.raises(InvalidValue, match=r"folds its image over 4[0-9] degrees"):
        Equidistant(REAL.fx, REAL.fy, REAL.cx, REAL.cy, (-0.5, 0.0, 0.0, 0.0))
    with pytest.raises(InvalidValue, match="4 coefficients, not 5"):
        lens_of(REAL, LensModel.EQUIDISTANT, (0.0,) * 5)
    with pytest.raises(InvalidValue, match="5 coefficients, not 4"):
        lens_of(REAL, LensModel.RADIAL_TANGENTIAL, K)


def test_the_ideal_camera_sees_the_middle_of_the_field():
    ideal, lens = lens_of(REAL, LensModel.EQUIDISTANT, K)
    assert (ideal.width, ideal.height) == (REAL.width, REAL.height)
    assert (ideal.mount_height, ideal.mount_forward) == (0.3, 0.1)
    assert ideal.semi_aperture == pytest.approx(WIDEST)
    # A lens that is narrower than that is shown to its edge.
    narrow = Camera(320, 240, 300.0, 300.0, 159.5, 119.5, 0.3)
    edge, lens = lens_of(narrow, LensModel.EQUIDISTANT, ())
    assert isinstance(lens, Equidistant)
    assert edge.semi_aperture == pytest.approx(159.5 / 300.0)
    corners = np.array([[0.0, 0.0], [319.0, 0.0], [0.0, 239.0], [319.0, 239.0]])
    shown = Lens(edge, lens).distort(corners)
    assert (shown > -1).all() and (shown < [320, 240]).all()


def test_a_rectified_image_is_a_pinholes():
    """A wall of texture straight ahead is a homography of the rectified image, as of any pinhole's."""
    ideal, lens = lens_of(REAL, LensModel.EQUIDISTANT, K)
    assert isinstance(lens, Equidistant)
    rng = np.random.default_rng(3)
    coarse = rng.integers(0, 255, (60, 80)).astype(np.uint8)
    texture = cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)

    def seen(rays: np.ndarray) -> np.ndarray:
        at = np.nan_to_num(rays * 180.0 + [320.0, 240.0], nan=-1.0).astype(np.float32).reshape(240, 320, 2)
        return cv2.remap(texture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 2)
    by_fisheye = seen(lens.rays(pixels))
    by_pinhole = seen((pixels - [ideal.cx, ideal.cy]) / [ideal.fx, ideal.fy])
    rectified = Lens(ideal, lens).rectified(by_fisheye)
    assert np.median(cv2.absdiff(rectified, by_pinhole)) <= 3
    features = Sift(Lens(ideal, lens)).extract(by_fisheye)
    assert len(features) > 50
    assert np.allclose(Lens(ideal, lens).undistort(features.raw), features.pixels, atol=1e-6)
    direct = Sift(Lens(ideal)).extract(by_pinhole)
    near = np.linalg.norm(features.pixels[:, None] - direct.pixels, axis=2).min(axis=1)
    assert np.median(near) < 0.5
