"""Simulated cameras against OpenCV's lens model, the agent's lens, brute force and statistics."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave import Camera, Pose2
from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.camera import CAMERAS, CameraSetup, Exposure, undistorted
from mapweave.sim.imager import Imager
from mapweave.sim.renderer import Renderer
from mapweave.sim.robots import RobotSetup
from mapweave.sim.scene import Scene
from mapweave.sim.texture import Texture
from mapweave.sim.world import PanelSet, upright_panel
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import Lens

COLUMNS, ROWS = 12, 9
"""Squares of a board that fills the picture."""
SILENT = {"read_noise": 0.0, "shot_noise": 0.0, "dropped": 0.0}


def board(distance: float, width: float) -> tuple[Scene, np.ndarray]:
    """A board of squares ahead, and its inner corners, (N, 3) m, in robot."""
    height = width * ROWS / COLUMNS
    squares = (np.arange(ROWS)[:, None] + np.arange(COLUMNS)) % 2
    grey = np.kron(30 + 190 * squares, np.ones((130, 130)))
    bottom = 0.3 - height / 2
    panel = upright_panel(
        (distance, width / 2),
        (distance, -width / 2),
        bottom,
        bottom + height,
        Texture.of(grey.astype(np.uint8)),
    )
    i, j = np.meshgrid(np.arange(1, COLUMNS), np.arange(1, ROWS))
    corners = np.column_stack(
        [
            np.full(i.size, distance),
            width / 2 - width * i.ravel() / COLUMNS,
            bottom + height - height * j.ravel() / ROWS,
        ]
    )
    return Scene([PanelSet.of([panel])]), corners


def still(setup: CameraSetup, scene: Scene, stand, **changes) -> np.ndarray:
    """One picture of a robot at the origin."""
    rotation, position = stand(Pose2())
    how = {"lamps": 1.0, "turn_rate": 0.0, "seconds": 0.0, **changes}
    return Imager(setup, 128, (1, 2)).picture(scene, (position, rotation), **how)


@pytest.mark.parametrize("name", ["wide", "phone", "cheap", "fisheye"])
def test_corners_agree_with_the_lens_model(name: str, stand):
    """Found as saddle points in the picture: against cv2.projectPoints, and the agent's lens undoes it."""
    exposure = replace(CAMERAS[name].exposure, gain_error=0.0, vignetting=0.0)
    setup = replace(CAMERAS[name], **SILENT, exposure=exposure)
    camera = setup.intrinsics
    scene, corners = board(1.0, 1.7 * 160 / camera.fx * 1.4)
    image = still(setup, scene, stand)
    in_camera = np.column_stack([-corners[:, 1], 0.3 - corners[:, 2], corners[:, 0]])
    lens = setup.distortion
    fisheye = isinstance(lens, Equidistant)
    real = lens if isinstance(lens, Equidistant) else camera
    matrix = np.array([[real.fx, 0, real.cx], [0, real.fy, real.cy], [0, 0, 1]])
    project, k = (cv2.fisheye.projectPoints, lens.k) if fisheye else (cv2.projectPoints, lens)
    expected, _ = project(in_camera[:, None], np.zeros(3), np.zeros(3), matrix, np.array(k))
    expected = expected[:, 0]
    inside = camera.contains(expected, 9.0)
    assert inside.sum() > 25
    # Some are near the border, where the lens bends most.
    assert np.linalg.norm(expected[inside] - camera.project(corners[inside]), axis=1).max() > 1.0
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-3)
    start = expected[inside].astype(np.float32)[:, None] + np.float32(0.7)
    result = cv2.cornerSubPix(image, start, (4, 4), (-1, -1), criteria)[:, 0]
    off = np.linalg.norm(result - expected[inside], axis=1)
    assert off.max() < 0.3
    assert np.abs((result - expected[inside]).mean(axis=0)).max() < 0.05
    description = RobotSetup("r0", camera=setup).describe()
    ideal = Lens(description.camera, description.distortion).undistort(result)
    # A pixel of a fisheye is several pixels of the ideal image, far from the axis.
    assert np.linalg.norm(ideal - camera.project(corners[inside]), axis=1).max() < (1.0 if fisheye else 0.5)


def test_an_ideal_lens_leaves_the_picture_alone(stand):
    """No distortion, no noise, light as painted: what the renderer draws."""
    setup = CameraSetup(**SILENT)
    scene, _ = board(1.0, 1.5)
    ideal = Renderer(setup.intrinsics, 128).render(scene, *stand(Pose2()))
    np.testing.assert_array_equal(still(setup, scene, stand), ideal)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(
        *[st.floats(-0.6, 0.6), st.floats(-0.5, 0.5), *[st.floats(-0.05, 0.05)] * 2, st.floats(-0.3, 0.3)]
    ),
    st.floats(130.0, 400.0),
)
def test_a_lens_is_refused_or_can_be_inverted(lens: tuple[float, ...], focal: float):
    """For any coefficients: the rays of an accepted lens fall back onto their pixels."""
    camera = Camera(width=320, height=240, fx=focal, fy=focal, cx=159.5, cy=119.5, mount_height=0.3)
    try:
        CameraSetup(camera, lens)
    except InvalidValue as error:
        assert "lens" in str(error)
        return
    u, v = np.meshgrid(np.arange(0, 320, 3.0), np.arange(0, 240, 3.0))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    matrix = np.array([[focal, 0, 159.5], [0, focal, 119.5], [0, 0, 1]])
    rays = undistorted(pixels, matrix, np.array(lens))
    again, _ = cv2.projectPoints(
        np.column_stack([rays, np.ones(len(rays))]), np.zeros(3), np.zeros(3), matrix, np.array(lens)
    )
    assert np.abs(again - pixels).max() < 0.06


@pytest.mark.parametrize(("read", "shot"), [(2.0, 0.0), (0.7, 0.0), (1.5, 4.0)])
def test_noise_is_as_strong_as_ordered(read: float, shot: float, stand):
    """Deviation, no bias, and nothing shared by one picture and the next."""
    for grey in (60, 180):
        wall = upright_panel((1.0, 3.0), (1.0, -3.0), -2.0, 3.0, Texture.plain(grey))
        exposure = Exposure(automatic=False)
        imager = Imager(CameraSetup(read_noise=read, shot_noise=shot, exposure=exposure), 0, (3, 4))
        rotation, position = stand(Pose2())
        scene = Scene([PanelSet.of([wall])])
        first, second = (
            imager.picture(scene, (position, rotation), 1.0, 0.0, 0.1).astype(float) for _ in range(2)
        )
        # Rounding to whole greys adds 1/12.
        sigma = math.sqrt(read**2 + shot**2 * grey / 255 + 1 / 12)
        assert first.std() == pytest.approx(sigma, rel=0.03)
        assert first.mean() == pytest.approx(grey, abs=0.05)
        assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02
        assert (first - second).std() == pytest.approx(math.sqrt(2) * sigma, rel=0.03)


def follow(exposure: Exposure, lamps: list[float], stand, grey: int = 130) -> list[float]:
    """Mean of a plain wall's pictures, one a tick."""
    wall = upright_panel((1.0, 3.0), (1.0, -3.0), -2.0, 3.0, Texture.plain(grey))
    scene = Scene([PanelSet.of([wall])])
    imager = Imager(CameraSetup(**SILENT, exposure=exposure), 0, (5, 6))
    rotation, position = stand(Pose2())
    return [float(imager.picture(scene, (position, rotation), lamp, 0.0, 0.1).mean()) for lamp in lamps]


def test_exposure_follows_the_light_with_a_lag(stand):
    """Dark at once, then back to the edge of the band by the time constant; too bright saturates."""
    exposure = Exposure(band=0.1, lag=0.5, wanted=130.0)
    means = follow(exposure, [1.0] * 3 + [0.4] * 40, stand)
    assert means[:3] == [130.0] * 3
    assert means[3] == pytest.approx(52.0, abs=0.6)
    edge = 130.0 * math.exp(-0.1)
    # The gap in the logarithm closes by exp(-0.1 / 0.5) a picture.
    gaps = np.log(edge / np.array(means[3:12]))
    assert np.diff(np.log(gaps)) == pytest.approx(-0.2, abs=0.05)
    assert means[-1] == pytest.approx(edge, rel=0.02)
    bright = follow(exposure, [1.0] + [3.0] * 40, stand)
    assert bright[1] == 255.0
    assert bright[-1] == pytest.approx(130.0 * math.exp(0.1), rel=0.02)
    fixed = follow(Exposure(automatic=False), [1.0, 0.4] + [0.4] * 20, stand)
    assert set(fixed[1:]) == {52.0}
    tolerant = follow(Exposure(band=0.5), [0.7] * 20, stand)
    assert set(tolerant) == {91.0}


def test_corners_get_less_light(stand):
    """By as much as ordered, and cameras of one kind differ by the gain error."""
    wall = upright_panel((1.0, 3.0), (1.0, -3.0), -2.0, 3.0, Texture.plain(200))
    scene = Scene([PanelSet.of([wall])])
    image = still(CameraSetup(**SILENT, exposure=Exposure(vignetting=0.4)), scene, stand)
    assert image[119:121, 159:161].mean() == pytest.approx(200, abs=1)
    assert image[0, 0] == pytest.approx(120, abs=2)
    rotation, position = stand(Pose2())
    setup = CameraSetup(**SILENT, exposure=Exposure(automatic=False, gain_error=0.1))
    means = [
        Imager(setup, 0, (7, k)).picture(scene, (position, rotation), 0.5, 0.0, 0.1).mean() / 100
        for k in range(40)
    ]
    assert np.std(means) == pytest.approx(0.1, rel=0.35)
    assert np.mean(means) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("turn_rate", [0.8, -0.5])
@pytest.mark.parametrize("name", ["webcam", "wide"])
def test_blur_is_the_mean_image(name: str, turn_rate: float, stand):
    """Against the mean of 41 sharp pictures taken on the way."""
    sharp = replace(CAMERAS[name], **SILENT, exposure=Exposure(automatic=False))
    slow = replace(sharp, exposure=Exposure(automatic=False, seconds=0.03))
    scene, _ = board(1.5, 3.0)
    blurred = still(slow, scene, stand, turn_rate=turn_rate).astype(float)
    total = np.zeros(blurred.shape)
    for share in (np.arange(41) + 0.5) / 41 - 0.5:
        rotation, position = stand(Pose2(0.0, 0.0, turn_rate * 0.03 * share))
        total += Imager(sharp, 128, (1, 2)).picture(scene, (position, rotation), 1.0, 0.0, 0.0)
    unblurred = still(sharp, scene, stand).astype(float)
    inner = (slice(12, -12), slice(16, -16))
    error = np.abs(blurred - total / 41)[inner]
    assert error.mean() < 0.3 * np.abs(unblurred - total / 41)[inner].mean()
    assert np.quantile(error, 0.99) < 10.0
    np.testing.assert_array_equal(still(slow, scene, stand, turn_rate=0.001), unblurred)


def test_frames_are_dropped_by_chance():
    """As often as ordered, the same for the same seed."""
    drops = [[imager.drops() for _ in range(2000)] for imager in (Imager(CAMERAS["cheap"], 0, (8, 9)),) * 1]
    again = Imager(CAMERAS["cheap"], 0, (8, 9))
    assert drops[0] == [again.drops() for _ in range(2000)]
    assert np.mean(drops[0]) == pytest.approx(CAMERAS["cheap"].dropped, abs=0.011)
    webcam = Imager(CAMERAS["webcam"], 0, (8, 9))
    assert not any(webcam.drops() for _ in range(50))
