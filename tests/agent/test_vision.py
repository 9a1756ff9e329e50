"""Lens, features and tracks against formulas of their own and images whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import skimage.data
from hypothesis import given
from hypothesis import strategies as st

from agent.observation import RobotDescription
from agent.vision.lens import Lens
from agent.vision.sift import Sift, SiftSettings
from agent.vision.tracker import Tracker
from hybridmap.camera import Camera

CAMERA = Camera(320, 240, 277.0, 276.0, 158.0, 121.0, mount_height=0.3)
IDEAL = Lens(RobotDescription(CAMERA))
PHOTOGRAPHS = ("camera", "brick", "coins", "page", "text")


def photograph(name: str) -> np.ndarray:
    """The middle of a picture, (240, 320) grey, as soft as a webcam's."""
    picture = getattr(skimage.data, name)()
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) if picture.ndim == 3 else picture
    scale = max(320 / grey.shape[1], 240 / grey.shape[0])
    if scale > 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    top, left = (grey.shape[0] - 240) // 2, (grey.shape[1] - 320) // 2
    return cv2.GaussianBlur(grey[top : top + 240, left : left + 320], (0, 0), 0.8)


def warped(image: np.ndarray, there_from_here: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """The image after a homography of its pixels, with a camera's noise."""
    moved = cv2.warpPerspective(
        image, there_from_here, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    grain = np.random.default_rng(1).normal(0, noise, moved.shape) if noise else 0.0
    return np.clip(moved + grain, 0, 255).round().astype(np.uint8)


def mapped(there_from_here: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points after a homography, by hand."""
    out = np.column_stack([points, np.ones(len(points))]) @ there_from_here.T
    return out[:, :2] / out[:, 2:]


def followed(image: np.ndarray) -> Tracker:
    """A tracker on an image's features."""
    tracker = Tracker(IDEAL)
    tracker.track(image)
    features = Sift(IDEAL).extract(image)
    tracker.add(np.arange(len(features)), features.raw)
    return tracker


# Lens

lenses = st.tuples(
    st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-0.003, 0.003), st.floats(-0.003, 0.003),
    st.floats(-0.02, 0.02),
)  # fmt: skip
some_pixels = st.lists(st.tuples(st.floats(20, 300), st.floats(20, 220)), min_size=1, max_size=20)


@given(lenses, some_pixels)
def test_removing_distortion_that_was_put_on_changes_nothing(coefficients, pixels):
    lens = Lens(RobotDescription(CAMERA, coefficients))
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
    found = Lens(RobotDescription(CAMERA, coefficients)).distort(pixels)
    assert np.allclose(found, expected, atol=1e-6)


def test_an_ideal_lens_and_no_points():
    pixels = np.array([[1.25, 3.5], [300.0, 2.0]])
    assert np.array_equal(IDEAL.undistort(pixels), pixels)
    assert np.array_equal(IDEAL.distort(pixels), pixels)
    IDEAL.undistort(pixels)[0] = 9.0
    assert pixels[0, 0] == 1.25, "what comes back is a copy"
    bent = Lens(RobotDescription(CAMERA, (0.1, 0.0, 0.0, 0.0, 0.0)))
    assert bent.undistort(np.zeros((0, 2))).shape == bent.distort(np.zeros((0, 2))).shape == (0, 2)


# Features


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_features_are_spread_and_each_has_a_place_of_its_own(name):
    settings = SiftSettings(most=80)
    image = photograph(name)
    features = Sift(IDEAL, settings).extract(image)
    assert 20 <= len(features) <= settings.most
    assert len({(round(x), round(y)) for x, y in features.raw}) == len(features)
    assert (np.diff(features.responses) <= 0).all(), "strongest first"
    assert features.codes.shape == (len(features), 16)
    assert CAMERA.contains(features.raw, settings.border_px - 1).all()
    cells = np.floor(features.raw * settings.cells / [320, 240]).astype(int)
    _, counts = np.unique(cells, axis=0, return_counts=True)
    assert counts.max() <= np.ceil(settings.crowding * settings.most / settings.cells**2)


def test_the_same_image_gives_the_same_features():
    one, two = (Sift(IDEAL).extract(photograph("camera")) for _ in range(2))
    assert np.array_equal(one.raw, two.raw)
    assert np.array_equal(one.codes, two.codes)


def test_pixels_are_free_of_the_lens():
    description = RobotDescription(CAMERA, (-0.2, 0.05, 0.001, 0.0, 0.0))
    features = Sift(Lens(description)).extract(photograph("camera"))
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
    lax = SiftSettings(least_texture=0.0, least_roundness=0.0)
    assert len(Sift(IDEAL, lax).extract(image)) > 10, "there is something to leave out"
    assert len(Sift(IDEAL).extract(image)) == 0
    # A spot is held in both directions, wherever it is, and so is all whose patch has it in view.
    spotted = cv2.circle(image.copy(), (160, 120), 5, 20, cv2.FILLED, cv2.LINE_AA)
    at = Sift(IDEAL).extract(spotted).raw
    assert len(at)
    assert (np.linalg.norm(at - [160, 120], axis=1) < 14).all()


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_what_is_kept_is_held_in_both_directions(name):
    image = photograph(name)
    settings = SiftSettings()
    weak, strong = structure(image, Sift(IDEAL, settings).extract(image).raw).T
    # Sobel's derivative smooths a little more than NumPy's differences.
    assert (weak > 0.8 * settings.least_texture).all()
    assert (weak > 0.5 * settings.least_roundness * strong).all()


# Tracks


@pytest.mark.parametrize("name", PHOTOGRAPHS)
@pytest.mark.parametrize("shift", [(0.3, -0.45), (-2.6, 1.15), (5.25, 0.5)])
def test_a_shift_is_followed_below_a_pixel(name, shift):
    image = photograph(name)
    tracker = followed(image)
    start, count = tracker.raw.copy(), len(tracker.ids)
    motion = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1.0]])
    tracker.track(warped(image, motion, noise=1.0))
    error = np.linalg.norm(tracker.raw - start[tracker.ids] - shift, axis=1)
    assert np.median(error) < 0.15
    assert np.mean(error < 1.0) > 0.9
    assert len(tracker.ids) > 0.7 * count


def approach(step: float) -> np.ndarray:
    """The homography of a slanted wall that a robot drives to, in frames since the first."""
    grown = 1 + 0.006 * step
    return np.array([
        [grown, 0.0008 * step, -160 * (grown - 1) + 0.7 * step],
        [-0.0008 * step, grown, -120 * (grown - 1)],
        [4e-6 * step, 0, 1],
    ])  # fmt: skip


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_a_drive_is_followed_over_many_frames(name):
    """The image of a wall grows and tilts frame by frame; errors add up as chance does, and no faster."""
    image = photograph(name)
    tracker = followed(image)
    start, count = tracker.raw.copy(), len(tracker.ids)
    for step in range(1, 11):
        motion = approach(step)
        tracker.track(warped(image, motion, noise=0.7))
        error = np.linalg.norm(tracker.raw - mapped(motion, start[tracker.ids]), axis=1)
        assert np.median(error) < 0.15 * np.sqrt(step)
    inside = CAMERA.contains(mapped(motion, start), 6.0).sum()
    assert inside * 0.7 < len(tracker.ids) <= count


def test_a_far_jump_is_followed_where_it_is_expected():
    image = photograph("camera")
    motion = np.array([[1, 0, 60.0], [0, 1, -12.0], [0, 0, 1.0]])
    moved = warped(image, motion)

    def right(expect: bool) -> int:
        tracker = followed(image)
        start = tracker.raw.copy()
        # A robot's expectation is not exact, and of some tracks it has none.
        expected = mapped(motion, start) + np.random.default_rng(2).normal(0, 1.5, start.shape)
        expected[::7] = np.nan
        tracker.track(moved, expected if expect else None)
        known = tracker.ids % 7 != 0
        error = np.linalg.norm(tracker.raw - mapped(motion, start[tracker.ids]), axis=1)
        assert not expect or np.median(error[known]) < 0.15
        return int((error < 1).sum())

    assert right(expect=True) > 2 * right(expect=False)


def test_points_that_leave_the_image_are_dropped_and_named():
    image = photograph("camera")
    tracker = followed(image)
    start, ids = tracker.raw.copy(), tracker.ids.copy()
    motion = np.array([[1, 0, 40.0], [0, 1, 0], [0, 0, 1.0]])
    shifted = np.full_like(image, 100)
    shifted[:, 40:] = image[:, :-40]
    lost = tracker.track(shifted, mapped(motion, start))
    assert sorted([*lost, *tracker.ids]) == sorted(ids)
    gone = ids[start[:, 0] > 320 - 40]
    assert len(gone) > 5
    assert np.isin(gone, lost).all()
    assert CAMERA.contains(tracker.raw, 3.0).all()
    assert np.linalg.norm(tracker.raw - start[tracker.ids] - [40, 0], axis=1).max() < 1.0


@pytest.mark.parametrize("cover", ["blank", "other"])
def test_points_that_are_hidden_are_dropped(cover):
    image = photograph("camera")
    tracker = followed(image)
    start = tracker.raw.copy()
    hidden = image.copy()
    hidden[60:200, 80:240] = 90 if cover == "blank" else photograph("brick")[60:200, 80:240]
    tracker.track(hidden)
    inside = (start > [88, 68]).all(axis=1) & (start < [232, 192]).all(axis=1)
    outside = (start < [68, 48]).any(axis=1) | (start > [252, 212]).any(axis=1)
    assert inside.sum() > 15
    assert np.isin(np.flatnonzero(inside), tracker.ids).mean() < 0.1
    assert np.isin(np.flatnonzero(outside), tracker.ids).mean() > 0.95


def test_a_camera_that_changes_its_size_loses_everything():
    tracker = followed(photograph("camera"))
    ids = tracker.ids.copy()
    assert np.array_equal(tracker.track(np.zeros((120, 160), np.uint8)), ids)
    assert len(tracker.ids) == len(tracker.raw) == 0


def test_points_are_added_kept_and_forgotten():
    tracker = Tracker(IDEAL)
    assert len(tracker.track(photograph("camera"))) == 0
    tracker.add(np.array([5, 9, 7]), np.array([[50.0, 60.0], [70.0, 80.0], [90.0, 100.0]]))
    tracker.keep(tracker.ids != 9)
    assert tracker.ids.tolist() == [5, 7]
    assert tracker.raw.tolist() == [[50.0, 60.0], [90.0, 100.0]]
    assert np.array_equal(tracker.pixels, tracker.raw)
    tracker.clear()
    assert len(tracker.ids) == 0
