"""The lens against the formula of its model, and against itself back and forth."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.vision.lens import Lens

CAMERA = Camera(320, 240, 277.0, 276.0, 158.0, 121.0, mount_height=0.3)
IDEAL = Lens(CAMERA)

lenses = st.tuples(
    st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-0.003, 0.003), st.floats(-0.003, 0.003),
    st.floats(-0.02, 0.02),
)  # fmt: skip
some_pixels = st.lists(st.tuples(st.floats(20, 300), st.floats(20, 220)), min_size=1, max_size=20)


@given(lenses, some_pixels)
def test_removing_distortion_that_was_put_on_changes_nothing(coefficients, pixels):
    lens = Lens(CAMERA, coefficients)
    there_and_back = lens.undistort(lens.distort(np.array(pixels)))
    assert np.abs(there_and_back - pixels).max() < 0.05
    back_and_there = lens.distort(lens.undistort(np.array(pixels)))
    assert np.abs(back_and_there - pixels).max() < 0.05


@given(lenses, some_pixels)
def test_distortion_is_brown_and_conradys_formula(coefficients, pixels):
    k1, k2, p1, p2, k3 = coefficients
    pixels = np.array(pixels)
    x, y = (pixels[:, 0] - CAMERA.cx) / CAMERA.fx, (pixels[:, 1] - CAMERA.cy) / CAMERA.fy
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    expected = np.column_stack([CAMERA.fx * xd + CAMERA.cx, CAMERA.fy * yd + CAMERA.cy])
    result = Lens(CAMERA, coefficients).distort(pixels)
    assert np.allclose(result, expected, atol=1e-6)


def test_an_ideal_lens_and_no_points():
    pixels = np.array([[1.25, 3.5], [300.0, 2.0]])
    assert np.array_equal(IDEAL.undistort(pixels), pixels)
    assert np.array_equal(IDEAL.distort(pixels), pixels)
    IDEAL.undistort(pixels)[0] = 9.0
    assert pixels[0, 0] == 1.25, "what comes back is a copy"
    bent = Lens(CAMERA, (0.1, 0.0, 0.0, 0.0, 0.0))
    assert bent.undistort(np.zeros((0, 2))).shape == bent.distort(np.zeros((0, 2))).shape == (0, 2)
