"""Features are spread, can be tracked, and are free of the lens."""

import cv2
import numpy as np
import pytest

from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.vision import sift
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift, SiftSettings

CAMERA = Camera(320, 240, 277.0, 276.0, 158.0, 121.0, mount_height=0.3)
IDEAL = Lens(CAMERA)
PHOTOGRAPHS = ("camera", "brick", "coins", "page", "text")


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_features_are_spread_and_each_has_a_place_of_its_own(pictures, name):
    settings = SiftSettings(most=80)
    image = pictures.photograph(name)
    features = Sift(IDEAL, settings).extract(image)
    assert 20 <= len(features) <= settings.most
    assert len({(round(x), round(y)) for x, y in features.raw}) == len(features)
    assert (np.diff(features.responses) <= 0).all(), "strongest first"
    assert features.codes.shape == (len(features), 32)
    assert CAMERA.contains(features.raw, sift.BORDER_PX - 1).all()
    cells = np.floor(features.raw * sift.CELLS / [320, 240]).astype(int)
    _, counts = np.unique(cells, axis=0, return_counts=True)
    assert counts.max() <= np.ceil(sift.CROWDING * settings.most / sift.CELLS**2)


def test_the_same_image_gives_the_same_features(pictures):
    first, second = (Sift(IDEAL).extract(pictures.photograph("camera")) for _ in range(2))
    assert np.array_equal(first.raw, second.raw)
    assert np.array_equal(first.codes, second.codes)


def test_pixels_are_free_of_the_lens(pictures):
    description = RobotDescription(CAMERA, (-0.2, 0.05, 0.001, 0.0, 0.0))
    features = Sift(Lens(description.camera, description.distortion)).extract(pictures.photograph("camera"))
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    at_one = (features.pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    rays = np.column_stack([at_one, np.ones(len(features))])
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(description.distortion))
    assert np.abs(seen[:, 0] - features.raw).max() < 0.05
    view = features.view(CAMERA)
    assert np.allclose(view.pixels, features.pixels, atol=1e-4)
    assert view.camera is CAMERA


@pytest.mark.parametrize("image", [np.full((240, 320), 128, np.uint8), np.zeros((240, 320), np.uint8)])
def test_a_blank_wall_has_no_features(image):
    features = Sift(IDEAL).extract(image)
    assert len(features) == 0
    assert features.pixels.shape == (0, 2)
    assert len(features.view(CAMERA)) == 0


def structure(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(N, 2) weak and strong mean squared gradient in an 11 x 11 px square, with NumPy alone."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(float)
    down, right = np.gradient(smooth)
    out = []
    for x, y in at.round().astype(int):
        gx, gy = right[y - 5 : y + 6, x - 5 : x + 6].ravel(), down[y - 5 : y + 6, x - 5 : x + 6].ravel()
        out.append(np.linalg.eigvalsh(np.array([[gx @ gx, gx @ gy], [gx @ gy, gy @ gy]]) / gx.size))
    return np.array(out).reshape(-1, 2)


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.9, np.pi / 2])
def test_points_on_an_edge_are_left_out(angle):
    """An edge in pixels is a fine staircase on which SIFT finds features; nothing holds them along it."""
    columns, rows = np.meshgrid(np.arange(320) - 160.0, np.arange(240) - 120.0)
    across = columns * np.cos(angle) + rows * np.sin(angle)
    along = rows * np.cos(angle) - columns * np.sin(angle)
    stairs = across + 0.5 * np.sin(along * 2 * np.pi / 14)
    edge = 120 + 80 * np.tanh(stairs / 1.5) + np.random.default_rng(0).normal(0, 1.0, (240, 320))
    image = edge.clip(0, 255).round().astype(np.uint8)
    with pytest.MonkeyPatch.context() as lax:
        lax.setattr(sift, "LEAST_TEXTURE", 0.0)
        lax.setattr(sift, "LEAST_ROUNDNESS", 0.0)
        everything = Sift(IDEAL).extract(image)
    assert len(everything) > 10, "there is something to leave out"
    assert len(Sift(IDEAL).extract(image)) == 0
    # A spot is held in both directions, at any position, and so are all patches that contain it.
    spotted = cv2.circle(image.copy(), (160, 120), 5, 20, cv2.FILLED, cv2.LINE_AA)
    at = Sift(IDEAL).extract(spotted).raw
    assert len(at)
    assert (np.linalg.norm(at - [160, 120], axis=1) < 14).all()


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_held_tracks_match_in_both_directions(pictures, name):
    image = pictures.photograph(name)
    settings = SiftSettings()
    weak, strong = structure(image, Sift(IDEAL, settings).extract(image).raw).T
    # Sobel's derivative smooths a little more than NumPy's differences.
    assert (weak > 0.8 * sift.LEAST_TEXTURE).all()
    assert (weak > 0.5 * sift.LEAST_ROUNDNESS * strong).all()


def test_a_region_that_is_left_out_has_no_features_and_others_take_their_place(pictures):
    image, settings = pictures.photograph("brick"), SiftSettings(most=60)
    lens = Lens(CAMERA, (-0.2, 0.05, 0.001, 0.0, 0.0))
    region = np.array([[100.0, 60.0, 220.0, 180.0], [-50.0, -50.0, 20.0, 300.0]])

    def inside(pixels):
        return (
            ((pixels[:, None] >= region[:, :2]) & (pixels[:, None] <= region[:, 2:])).all(axis=2).any(axis=1)
        )

    whole, rest = Sift(lens, settings).extract(image), Sift(lens, settings).extract(image, region)
    assert inside(whole.pixels).sum() >= 5 and not inside(rest.pixels).any()
    outside = {tuple(pixel) for pixel in whole.raw[~inside(whole.pixels)]}
    assert outside <= {tuple(pixel) for pixel in rest.raw} and len(rest) > len(outside)
