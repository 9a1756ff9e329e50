"""Large images: a place of the scene is seen where the reduced camera says, to a fraction of a pixel."""

import math

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.image_reduction import (
    MOST_PIXELS,
    ImageSize,
    reduced_image,
    reduced_optics,
    reduced_size,
)
from mapweave.vision.lens import NO_DISTORTION, Distortion, Lens
from tests.quick import first_quick

SIZES = [(801, 601), (760, 1350), (1280, 720), (1601, 1201), (3840, 2160), (5000, 100), (16384, 16384)]
POINTS = np.array([[3.0, 0.4, 0.2], [2.5, -0.4, 0.9], [5.0, 0.0, 0.4], [4.0, 1.1, 0.1], [2.5, 0.5, 0.7]])
"""m, in the robot's frame."""
WEBCAM = (-0.28, 0.09, 0.001, -0.0005, -0.01)


def optics_of(width: int, height: int, kind: str) -> tuple[Camera, Distortion]:
    focal, cx, cy = 0.9 * max(width, height), 0.502 * width, 0.49 * height
    if kind == "fisheye":
        lens = Equidistant(0.5 * focal, 0.502 * focal, cx, cy, (-0.02, 0.004, -0.003, 0.0005))
        return lens.ideal(width, height, 0.4, 0.1), lens
    camera = Camera(width, height, focal, 0.99 * focal, cx, cy, mount_height=0.4, mount_forward=0.1)
    return camera, WEBCAM if kind == "webcam" else NO_DISTORTION


def spots(size: tuple[int, int], pixels: Array, sigma: float) -> np.ndarray:
    """An image with a bright spot at each pixel."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    image = np.zeros((size[1], size[0]))
    for px, py in pixels:
        image += 255.0 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2.0 * sigma**2))
    return np.minimum(np.round(image), 255.0).astype(np.uint8)


def centre(image: np.ndarray, near: Array, radius: float) -> Array:
    """The middle of the light around a pixel."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    light = image * (np.hypot(x - near[0], y - near[1]) < radius)
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


@pytest.mark.parametrize("size", SIZES)
def test_every_shape_is_reduced_to_the_same_area(size: tuple[int, int]):
    """By width alone, an upright image of 760x1350 was not reduced, and 801x601 became 400x300."""
    small = reduced_size(*size)
    assert 0.97 * MOST_PIXELS <= small.width * small.height <= MOST_PIXELS
    assert small.width / small.height == pytest.approx(size[0] / size[1], rel=1.0 / min(small))


@pytest.mark.parametrize("size", [(800, 600), (640, 480), (621, 188), (512, 384), (600, 800), (16, 16)])
def test_small_images_stay_as_they_are(size: tuple[int, int]):
    assert reduced_size(*size) == size
    image = np.zeros((size[1], size[0]), np.uint8)
    assert reduced_image(image, reduced_size(*size)) is image
    optics = optics_of(*size, "webcam")
    assert reduced_optics(*optics, reduced_size(*size)) == optics


@pytest.mark.parametrize("kind", ["ideal", "webcam", "fisheye"])
@pytest.mark.parametrize(
    "size", first_quick([((801, 601),), ((760, 1350),), ((1280, 720),), ((2592, 1944),)], 3)
)
def test_a_point_is_seen_where_the_reduced_camera_says(size: tuple[int, int], kind: str):
    camera, lens = optics_of(*size, kind)
    small_size = reduced_size(*size)
    small, small_lens = reduced_optics(camera, lens, small_size)
    assert (small.width, small.height) == small_size
    raw, expected = (Lens(c, d).distort(c.project(POINTS)) for c, d in ((camera, lens), (small, small_lens)))
    assert small.contains(expected, 5.0).all()
    factor = size[0] / small_size.width
    image = reduced_image(spots(size, raw, 2.0 * factor), small_size)
    for pixel in expected:
        assert centre(image, pixel, 8.0) == pytest.approx(pixel, abs=0.05)


def test_the_reduced_image_of_a_flat_grey_is_that_grey():
    image = np.full((1350, 760), 113, np.uint8)
    small = reduced_image(image, reduced_size(760, 1350))
    assert small.dtype == np.uint8 and (small == 113).all()


def test_a_fine_pattern_does_not_alias():
    """Stripes of a pixel, which a point sample would turn into wide ones, become grey."""
    image = np.zeros((1944, 2592), np.uint8)
    image[:, ::2] = 200
    small = reduced_image(image, reduced_size(2592, 1944))
    wide = cv2.GaussianBlur(small, (0, 0), 2.0)
    assert np.abs(wide[20:-20, 20:-20].astype(float) - 100.0).max() < 8.0


def test_a_reduced_fisheye_shows_the_field_that_its_image_has_when_it_is_calibrated_so():
    """A robot records reduced images with their lens: a replay finds the ideal camera that the robot had."""
    camera, lens = optics_of(1600, 1200, "fisheye")
    small, small_lens = reduced_optics(camera, lens, ImageSize(800, 600))
    assert isinstance(small_lens, Equidistant)
    assert small == small_lens.ideal(800, 600, camera.mount_height, camera.mount_forward)
    assert small.semi_aperture == pytest.approx(camera.semi_aperture, abs=math.radians(0.1))
