"""Headings of poses, held against the way."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from mapweave import Camera
from mapweave.agent.drivers.replay import Replay
from mapweave.agent.observation import Odometry
from mapweave.agent.recordings.odometry_checks import contradiction
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array, Pose2
from tests.recordings import camera_toml, write_folder


def driven(seed: int, step: float = 0.02) -> Array:
    """(600, 3) poses of a drive with turns to both sides, stops, turns on the spot and stretches back."""
    rng = np.random.default_rng(seed)
    pose, poses = Pose2(1.0, 2.0, rng.uniform(-3.0, 3.0)), list[Array]()
    for _ in range(30):
        forward, turn = step * rng.choice([1.0, 1.0, 1.0, 0.0, -1.0]), rng.uniform(-0.08, 0.08)
        for _ in range(20):
            pose = pose @ Odometry(forward * rng.normal(1.0, 0.02), turn * rng.normal(1.0, 0.02)).motion()
            poses.append(pose.vector)
    return np.array(poses)


@pytest.mark.parametrize("seed", range(20))
def test_right_headings_are_right(seed: int):
    poses = driven(seed)
    assert not contradiction(poses)
    assert not contradiction(poses + np.array([0.0, 0.0, math.pi])), "a robot may drive back all the time"
    assert not contradiction(poses + np.random.default_rng(seed).normal(0.0, [0.01, 0.01, 0.05], poses.shape))
    assert not contradiction(poses[:40]) and not contradiction(poses[:1])
    assert not contradiction(np.tile(poses[:1], (50, 1)))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (np.degrees, "in degrees"),
        (lambda heading: -heading, "positive to the left"),
        (lambda heading: math.pi / 2 - heading, "x and y are exchanged"),
        (lambda heading: heading - math.pi / 2, "90 degrees off"),
        (lambda heading: 3.0 * np.sin(np.arange(600)), ""),
    ],
    ids=["degrees", "reversed", "compass", "sideways", "held in the hand"],
)
def test_wrong_headings_are_named(seed: int, spoil: Callable[[Array], Array], words: str):
    poses = driven(seed)
    said = contradiction(np.column_stack([poses[:, :2], spoil(poses[:, 2])]))
    assert words in said and bool(said) is bool(words)


@pytest.mark.parametrize("seed", range(5))
def test_headings_that_were_never_filled_in_are_named(seed: int):
    poses = driven(seed)
    empty = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    assert "all the same while the way turns" in contradiction(empty)
    straight = np.column_stack([np.arange(600) * 0.01, np.zeros(600), np.zeros(600)])
    assert not contradiction(straight)


def test_a_recording_with_headings_in_degrees_is_refused(tmp_path):
    poses, camera = driven(0), Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)
    folder = write_folder(tmp_path / "walk", [np.zeros((48, 64), np.uint8)] * 3, camera=camera_toml(camera))
    for times, refused in ((1.0, False), (math.degrees(1.0), True)):
        rows = [f"{0.1 * k},{x},{y},{times * heading}" for k, (x, y, heading) in enumerate(poses)]
        text = "\n".join(["stamp_s,x_m,y_m,heading_rad", *rows, ""])
        (folder / "odometry.csv").write_text(text)
        if not refused:
            Replay(folder)
            continue
        with pytest.raises(DeviceError, match=r"walk: poses of the odometry: headings are in degrees"):
            Replay(folder)
