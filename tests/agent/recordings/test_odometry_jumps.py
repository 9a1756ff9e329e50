"""Odometry that jumps once, as where the counts of an encoder wrap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.drivers.replay import Replay
from mapweave.agent.recordings.odometry_checks import bridged
from mapweave.hybridmap.pose import Array
from tests.recordings import write_folder

COUNT, AXLE = 80, 0.3
STAMPS = 1_795_889_292_000_000_000 + 100_000_000 * np.arange(COUNT)


def drive(seed: int = 1) -> Array:
    """(80, 2) m and rad between images: a robot that speeds up, turns, and stands in the end."""
    rng = np.random.default_rng(seed)
    forward = 0.03 * np.clip(np.arange(COUNT) / 10, 0, 1) * (np.arange(COUNT) < 70)
    increments = np.stack([forward * rng.normal(1.0, 0.1, COUNT), 0.05 * rng.normal(size=COUNT)], axis=1)
    increments[0] = 0.0
    return increments


def wrapped(increments: Array, images: tuple[int, ...], way: float) -> Array:
    """With counts of one wheel and then of the other that wrap, by so many m."""
    wrong = increments.copy()
    for side, k in zip((1.0, -1.0), images, strict=False):
        wrong[k] += way / 2, side * way / AXLE
    return wrong


@pytest.mark.parametrize("images", [(40,), (40, 41), (33, 52), (1,)])
@pytest.mark.parametrize("way", [2.99, -5.59, 29.1])
def test_counts_that_wrap_are_bridged_and_named(images: tuple[int, ...], way: float):
    """By 16 bits of the encoders of a Koala, a Kobuki and a Create. They were mapped as driven."""
    right = drive()
    made, (line,) = bridged(wrapped(right, images, way), STAMPS)
    assert f"image {images[0]}, {images[0] / 10:.1f} s after the first" in line and "\n" not in line
    assert ("jumps once" if len(images) == 1 else "jumps 2 times") in line
    assert np.abs(made[:, 0] - right[:, 0]).max() < 0.03, "a step"
    others = np.delete(np.arange(COUNT), images)
    assert np.array_equal(made[others], right[others])


@given(st.integers(0, 1000), st.integers(1, 4), st.floats(0.0, 4.5))
def test_a_right_drive_is_left_as_it_is(seed: int, fast: int, times: float):
    """Also one with a few quick steps, and one that hardly drives."""
    right = drive(seed)
    top = float(np.abs(right[:, 0]).max())
    right[40 : 40 + fast, 0] = times * top
    made, lines = bridged(right, STAMPS)
    assert lines == [] and made is right
    standing = np.zeros((COUNT, 2))
    standing[:, 0] = 1e-4 * np.random.default_rng(seed).random(COUNT)
    standing[40 : 40 + fast, 0] = 0.03
    standing[60:75, 0] = 0.0
    rare = np.zeros((COUNT, 2))
    rare[10 : 10 + fast, 0] = times
    for still in (rare, np.zeros((COUNT, 2)), standing[:20], right[:1], right[:2]):
        assert bridged(still, STAMPS[: len(still)])[1] == []


def test_an_image_that_is_late_makes_no_jump():
    """The way since the image before is longer, and the time is, too."""
    right, stamps = drive(), STAMPS.copy()
    right[40, 0] *= 60
    stamps[40:] += 5_900_000_000
    assert bridged(right, stamps)[1] == []


def test_a_recording_with_a_wrap_is_read_without_it(tmp_path):
    images = (np.full((240, 320), k, np.uint8) for k in range(COUNT))
    odometry = wrapped(drive(), (40,), 5.59).tolist()
    replay = Replay(write_folder(tmp_path / "walk", images, odometry, timed=True))
    assert replay.damage == [] and ["jumps once" in note for note in replay.recording.notes] == [True]
    assert np.abs(replay.recording.increments[:, 0]).max() < 0.05
