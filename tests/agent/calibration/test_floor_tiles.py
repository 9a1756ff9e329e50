"""Tiles of the floor against images of a plane that are rendered ray by ray."""

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave.agent.calibration import recorded_drive
from mapweave.agent.calibration.camera_motions import CameraMotions, WheelTrack, rotations
from mapweave.agent.calibration.estimate import Estimate
from mapweave.agent.calibration.estimator import Estimator
from mapweave.agent.calibration.floor_scale import floor_scale
from mapweave.agent.calibration.floor_tiles import FloorTiles
from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.calibration.pair_information import ImagePair, floor_points
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import NO_DISTORTION, Distortion, Lens
from tests.agent.calibration.room_drive import CAMERA, drive, render

HEIGHT = 0.25
TEXEL = 0.01
"""Of the floor's pattern, m."""
DOWN = np.array([0.0, 1.0, 0.0])
WAY = np.array([0.02, 0.0, 0.3])
"""Of the camera, in its own frame, m,"""
TURN = np.array([0.01, -0.04, 0.003])
"""and by how much it turns, rad."""


def seen(pattern: Array, rotation: Array, centre: Array, lens: Lens, gain: float) -> NDArray[np.uint8]:
    """The floor as a camera at this pose in the first camera's frame sees it; four rays a pixel."""
    height, width = CAMERA.height, CAMERA.width
    v, u = (np.mgrid[: 2 * height, : 2 * width] - 0.5) / 2.0
    pixels = lens.undistort(np.column_stack([u.ravel(), v.ravel()]))
    rays = np.column_stack([(pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(u.size)])
    d = rays @ rotation.T
    reach = (HEIGHT - centre @ DOWN) / np.where(d[:, 1] > 0.02, d[:, 1], np.inf)
    p = centre + reach[:, None] * d
    place = ((p[:, [0, 2]] / TEXEL) % (len(pattern) - 1)).astype(np.float32)
    column, row = place.T.reshape(2, *u.shape)
    grey = cv2.remap(pattern.astype(np.float32), column, row, cv2.INTER_LINEAR)
    shade = 1.0 - 0.4 * (((u - CAMERA.cx) / 160.0) ** 2 + ((v - CAMERA.cy) / 120.0) ** 2) / 2.0
    image = gain * shade * np.where(reach.reshape(u.shape) > 0.0, grey, 90.0)
    image = image.reshape(height, 2, width, 2).mean((1, 3))
    return np.clip(image + np.random.default_rng(1).normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)


def ratios(
    pattern: Array, assumed: float = HEIGHT, distortion: Distortion = NO_DISTORTION, gain: float = 1.0
) -> Array:
    """Logarithms of an assumed over the measured height, by the tiles of one pair."""
    lens = Lens(CAMERA, distortion)
    turned = rotations(TURN)
    tiles = FloorTiles(CAMERA, lens)
    before = tiles.part(seen(pattern, np.eye(3), np.zeros(3), lens, 1.0))
    after = tiles.part(seen(pattern, turned, WAY, lens, gain))
    at = CameraMotions(turned.T, -turned.T @ WAY, DOWN / assumed)
    nothing = np.zeros((0, 2))
    pair = ImagePair(0.0, 1.0, nothing, nothing, tiles.match(before, after, at))
    return np.log(assumed / (floor_points(pair, at, 0.5 / CAMERA.fx).points @ DOWN))


def carpet(contrast: float) -> Array:
    """A random pattern without sharp edges."""
    rng = np.random.default_rng(0)
    smooth = cv2.GaussianBlur(rng.normal(0.0, 1.0, (1024, 1024)), (0, 0), 2.0)
    return np.asarray(120.0 + contrast * smooth / smooth.std())


@pytest.mark.parametrize(
    ("assumed", "gain", "distortion"),
    [
        (0.25, 1.0, NO_DISTORTION),
        (0.25, 0.85, NO_DISTORTION),
        (0.25 * 1.05, 1.15, NO_DISTORTION),
        (0.25 / 1.1, 1.0, (-0.28, 0.07, 0.0006, -0.0004, 0.0)),
    ],
)
def test_a_floor_of_little_texture_tells_its_depth(assumed: float, gain: float, distortion: Distortion):
    """To half a percent, while the light changes, for a height that is declared wrongly, behind any lens."""
    logs = ratios(carpet(10.0), assumed, distortion, gain)
    assert len(logs) >= 15
    assert float(np.median(logs)) == pytest.approx(math.log(assumed / HEIGHT), abs=0.005)
    assert float(np.abs(logs - np.median(logs)).mean()) < 0.01


def test_slopes_of_single_pairs_do_not_bend_the_scale():
    """A crest: for half of the drive the floor falls away by 0.4 degrees."""
    rng = np.random.default_rng(0)
    numbers = np.repeat(np.arange(120), 20)
    flatness = rng.uniform(3.0, 8.0, len(numbers))
    slope = np.where(np.arange(120) < 60, -0.007, 0.0) + rng.normal(0.0, 0.002, 120)
    sigmas = np.full(len(numbers), 0.02)
    logs = 0.03 + slope[numbers] * flatness + rng.normal(0.0, 0.03, len(numbers))
    standing = rng.random(len(numbers)) < 0.2
    logs[standing] = rng.uniform(0.1, 0.8, int(standing.sum()))
    found = floor_scale(logs, sigmas, flatness, numbers, 4)
    flat = floor_scale(logs, sigmas, 1e-6 * flatness, numbers, 4)
    assert found is not None
    assert flat is not None
    assert abs(found.log - 0.03) < 3.0 * found.sigma < 0.03
    assert abs(flat.log - 0.03) > 0.015


WAY_AHEAD = 0.1
"""From each image of `carpet_drive` to the next, m."""


@pytest.fixture(scope="module")
def carpet_drive() -> list[Observation]:
    """Straight on over a carpet towards a wall, with wheels that report 4 % too much."""
    pattern, wall, lens = carpet(10.0), carpet(40.0), Lens(CAMERA)
    observations = []
    for k in range(7):
        image = seen(pattern, np.eye(3), np.array([0.0, 0.0, k * WAY_AHEAD]), lens, 1.0)
        larger = 2.0 / (2.0 - k * WAY_AHEAD) * np.eye(2)
        centre = np.array([[CAMERA.cx], [CAMERA.cy]])
        onto = np.hstack([larger, centre - larger @ np.full((2, 1), 512.0)])
        above = cv2.warpAffine(wall, onto, (CAMERA.width, CAMERA.height))[:100]
        image[:100] = np.clip(above, 0, 255)
        observations.append(
            Observation(1 + 300_000_000 * k, Odometry(1.04 * WAY_AHEAD if k else 0.0, 0.0), image)
        )
    return observations


def test_a_robot_that_maps_sees_how_far_it_goes(carpet_drive: list[Observation]):
    """Each pair tells that the wheels report too much."""
    points = np.random.default_rng(2).uniform([-2.0, -1.0, 0.5], [2.0, 0.2, 4.0], (80, 3))
    online = OnlineCalibration(RobotDescription(CAMERA))
    for k, observation in enumerate(carpet_drive):
        assert observation.image is not None
        online.correct(observation)
        local = points - [0.0, 0.0, k * WAY_AHEAD]
        pixels = local[:, :2] / local[:, 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
        seeable = np.flatnonzero((local[:, 2] > 0.3) & CAMERA.contains(pixels, 4.0))
        online.watch(observation.image, points, seeable, pixels[seeable])
    floors = [information.floor for information in online._estimator.informations]
    assert len(floors) >= 3
    for floor in floors:
        assert len(floor.points) >= 10
        assert float(np.median(floor.points @ DOWN)) == pytest.approx(1.04 * HEIGHT, rel=0.01)


def test_a_recorded_drive_has_the_same_tiles(carpet_drive: list[Observation], monkeypatch):
    """By its tiles alone each pair tells it, too."""
    batches = list[Sequence[ImagePair]]()

    def batch(_: Estimator, pairs: Sequence[ImagePair], wheels: WheelTrack) -> Estimate:
        batches.append(pairs)
        raise InvalidValue("enough")

    monkeypatch.setattr(Estimator, "batch", batch)
    for least in ("FEWEST_PAIRS", "LEAST_S", "LEAST_TURN"):
        monkeypatch.setattr(recorded_drive, least, 0)
    with pytest.raises(InvalidValue, match="enough"):
        recorded_drive.calibrate(RobotDescription(CAMERA), carpet_drive)
    (pairs,) = batches
    assert len(pairs) >= 3
    still, nothing = np.eye(3), np.zeros((0, 2))
    for pair in pairs:
        counted = round((pair.last_s - pair.first_s) / 0.3) * 1.04 * WAY_AHEAD
        at = CameraMotions(still, np.array([0.0, 0.0, -counted]), DOWN / HEIGHT)
        tiles = floor_points(replace(pair, before=nothing, after=nothing), at, 0.5 / CAMERA.fx).points
        assert len(tiles) >= 10
        assert float(np.median(tiles @ DOWN)) == pytest.approx(1.04 * HEIGHT, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_a_recorded_drive_over_a_bare_floor_shows_how_far_the_wheels_go(seed: int):
    """The floor has a seventh of the walls' contrast: corners alone do not show it."""
    small = replace(CAMERA, width=160, height=120, fx=138.5, fy=138.5, cx=79.5, cy=59.5)
    true = DriveGeometry(wheel_scale=0.96, forward=CAMERA.mount_forward, height=CAMERA.mount_height)
    run = drive(np.random.default_rng(seed), true, 14.0, camera=small)
    run = replace(run, stamps=run.stamps[::2], poses=run.poses[::2])
    way, turn = (np.interp(run.stamps, run.wheels.stamps, c) for c in (run.wheels.way, run.wheels.turn))
    moved = zip(np.diff(way, prepend=way[0]), np.diff(turn, prepend=turn[0]), strict=True)
    observations = [
        Observation(1 + round(1e9 * stamp), Odometry(*counted), image)
        for stamp, counted, image in zip(run.stamps, moved, render(run, floor=0.15), strict=True)
    ]
    estimate = recorded_drive.calibrate(RobotDescription(small), observations).estimate
    assert estimate.shown[Parameter.WHEEL_SCALE]
    assert estimate.geometry.wheel_scale == pytest.approx(true.wheel_scale, rel=0.015)
