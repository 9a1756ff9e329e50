"""The trackers' benchmark: its truth, its last line, and bad input."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.tracking.benchmark import follow
from benchmarks.tracking.scenes import TEXEL_PX, Drive, room_drive, wall_drive, wall_to_image
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.camera import WEBCAM
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command, as a user gives it."""
    command = [sys.executable, "-m", "benchmarks.tracking", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_the_homography_is_the_cameras_projection():
    """Points of a slanted wall, put into space by hand."""
    picture, depth, slant = np.zeros((101, 201), np.uint8), 2.0, 0.4
    pose = Pose2(0.3, -0.1, 0.15)
    texels = np.array([[100.0, 50.0], [0.0, 0.0], [200.0, 0.0], [30.0, 90.0]])
    metres = (texels - [100.0, 50.0]) * TEXEL_PX * depth / WEBCAM.fx
    right, down = metres.T
    away, left, up = depth - right * np.sin(slant), -right * np.cos(slant), WEBCAM.mount_height - down
    points = np.column_stack([away, left, up])
    seen = np.column_stack([texels, np.ones(4)]) @ wall_to_image(picture, depth, slant, pose).T
    assert np.allclose(seen[:, :2] / seen[:, 2:], WEBCAM.project(pose.inverse().apply(points)))


@pytest.fixture(scope="module", params=["wall", "room"])
def drive(request: pytest.FixtureRequest) -> Drive:
    """A short drive."""
    make = wall_drive if request.param == "wall" else room_drive
    return make(np.random.default_rng(5), 16)


def test_the_truth_agrees_with_the_pictures(drive: Drive):
    """Features found again in a later picture, by SIFT alone, are where the truth has those of the first."""
    lens = Lens(drive.description.camera, drive.description.distortion)
    first, last = (Sift(lens).extract(drive.images[k]) for k in (0, -1))
    truth = drive.truth(first.pixels)
    known = np.isfinite(truth[0]).all(axis=1)
    assert known.sum() > 15
    assert np.allclose(truth[0][known], first.pixels[known], atol=1e-6)
    there = truth[-1][np.isfinite(truth[-1]).all(axis=1)]
    nearest = np.linalg.norm(there[:, None] - last.pixels[None], axis=2).min(axis=1)
    chance = np.linalg.norm(there[:, None] + [5.0, 4.0] - last.pixels[None], axis=2).min(axis=1)
    assert np.mean(nearest < 1.0) > max(0.5, 2 * np.mean(chance < 1.0))


def test_all_trackers_follow_most_points(drive: Drive):
    for name, outcome in follow(drive).items():
        errors = outcome.errors_px[-1]
        assert np.nanmedian(errors) < 1.0, name
        assert np.isfinite(errors).sum() > 0.5 * outcome.in_view.sum(), name


@pytest.mark.slow
def test_the_last_line_is_for_scripts():
    done = run("--drives", "1", "--frames", "12", "--seed", "3", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert (result["seed"], result["drives"], result["frames"]) == (3, 1, 12)
    for scene in ("walls", "rooms"):
        assert list(result[scene]) == ["plain", "checked", "held"]
        for figures in result[scene].values():
            assert set(figures["rms_px"]) == {"1", "10"}
            assert 0 <= figures["wrong"] <= 1
            assert figures["points"] > 10
            assert figures["ms"] > 0
