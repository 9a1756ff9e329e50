"""Calibration while mapping, on tracks that are drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from synthetic.room_drive import CAMERA, SIDE, RoomDrive, camera_poses, drive

BLANK = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
SOURCE = object()


def watched(run: RoomDrive, declared: DriveGeometry, seed: int) -> OnlineCalibration:
    """What the agent has found out at the end of a drive past points in the room."""
    rng = np.random.default_rng(seed)
    camera = replace(CAMERA, mount_forward=declared.forward, mount_height=declared.height)
    online = OnlineCalibration(RobotDescription(camera, geometry=declared))
    half = 0.5 * np.array(SIDE)
    points = np.column_stack([rng.uniform(-half, half, (4000, 2)), rng.uniform(0.0, 1.5, 4000)])
    rotation, centre = camera_poses(run)
    way, turn = (np.interp(run.stamps, run.wheels.stamps, c) for c in (run.wheels.way, run.wheels.turn))
    for k, stamp in enumerate(run.stamps):
        wheels = Odometry(float(way[k] - way[max(k - 1, 0)]), float(turn[k] - turn[max(k - 1, 0)]))
        online.correct(Observation(round(stamp * 1e9) + 1, wheels))
        local = (points - centre[k]) @ rotation[k]
        ahead = local[:, 2] > 0.3
        pixels = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None] * CAMERA.fx + [
            CAMERA.cx,
            CAMERA.cy,
        ]
        ids = np.flatnonzero(ahead & CAMERA.contains(pixels, 4.0))[:150]
        online.watch(BLANK, SOURCE, ids, pixels[ids] + rng.normal(0.0, 0.3, (len(ids), 2)))
        online.switched()
    return online


@pytest.mark.parametrize("seed", range(3))
def test_a_right_geometry_is_left_alone(seed: int):
    true = DriveGeometry(forward=0.1, height=0.3)
    online = watched(drive(np.random.default_rng(seed), true, 40.0), true, seed)
    assert not online.causes
    assert online.geometry.forward == pytest.approx(0.1, abs=0.1)


@pytest.mark.parametrize(
    ("parameter", "amount"), [(Parameter.FORWARD, 0.5), (Parameter.HEADING, 0.05), (Parameter.PITCH, 0.05)]
)
def test_a_wrong_geometry_is_named_and_mended(parameter: Parameter, amount: float):
    true = DriveGeometry(forward=0.1, height=0.3)
    vector = true.vector
    vector[parameter] += amount
    declared = DriveGeometry.of(vector)
    online = watched(drive(np.random.default_rng(1), true, 40.0), declared, 1)
    assert parameter in [cause.parameter for cause in online.causes]
    left = abs(online.geometry.vector[parameter] - true.vector[parameter])
    assert left < 0.3 * amount


def test_a_robot_that_stands_learns_nothing():
    online = OnlineCalibration(RobotDescription(CAMERA))
    rng = np.random.default_rng(0)
    pixels = rng.uniform(10, 200, (60, 2))
    for k in range(100):
        online.correct(Observation((k + 1) * 100_000_000, Odometry(0.0, 0.0)))
        online.watch(BLANK, SOURCE, np.arange(60), pixels + rng.normal(0.0, 0.3, pixels.shape))
    assert online.estimate is None
    assert not online.causes


def test_a_clock_that_goes_back_is_survived():
    true = DriveGeometry(forward=0.1, height=0.3)
    online = watched(drive(np.random.default_rng(1), true, 20.0), true, 1)
    online.correct(Observation(1, Odometry(0.1, 0.0)))
    assert online.estimate is None
