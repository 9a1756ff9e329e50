"""Unit and signs of odometry, held against the image."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave.agent.mission import Carried
from mapweave.agent.observation import Observation, Odometry
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.sensor_health.odometry_convention import OdometryConvention
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from tests.agent.conftest import CAMERA, DESCRIPTION, PhotoWalls

REVERSED, DEGREES = "the other way", "in degrees"


def drive(walls: PhotoWalls, times: float, every: int = 1, step: float = 0.01) -> list[Observation]:
    """Swings to both sides and drives ahead; wheels that report so many times the turn."""
    poses = [Pose2(step * k, 0.0, 0.25 * math.sin(0.15 * k)) for k in range(0, 90, every)]
    seen, before = [], poses[0]
    for k, pose in enumerate(poses):
        moved = before.inverse() @ pose
        odometry = Odometry(math.hypot(moved.x, moved.y), times * moved.heading)
        seen.append(Observation(1 + k * every * 100_000_000, odometry, walls.render(pose)))
        before = pose
    return seen


def complaint(seen: list[Observation]) -> str:
    convention = OdometryConvention(CAMERA)
    for observation in seen:
        convention.see(observation)
    return "; ".join(convention.complaints)


@pytest.mark.parametrize("every", [1, 4])
@pytest.mark.parametrize(
    ("times", "words"),
    [
        (1.0, ()), (0.8, ()), (1.25, ()), (0.0, ()), (5.0, ()), (-1.0, (REVERSED,)),
        (math.degrees(1.0), (DEGREES,)), (-math.degrees(1.0), (DEGREES, REVERSED)),
    ],
)  # fmt: skip
def test_a_wrong_unit_or_sign_is_named_and_a_wrong_scale_is_not(
    walls: PhotoWalls, every: int, times: float, words: tuple[str, ...]
) -> None:
    line = complaint(drive(walls, times, every))
    assert bool(line) is bool(words) and "\n" not in line
    for word in (REVERSED, DEGREES):
        assert (word in line) is (word in words), line


@pytest.mark.parametrize(
    ("turned", "words"),
    [
        (lambda image: image[:, ::-1], "mirrored"),
        (lambda image: image[::-1, ::-1], "upside down"),
        (lambda image: image, ""),
    ],
    ids=["mirrored", "upside down", "right"],
)
def test_an_image_that_is_mirrored_or_upside_down_turns_the_other_way(walls, turned, words: str) -> None:
    seen = [replace(one, image=np.ascontiguousarray(turned(one.image))) for one in drive(walls, 1.0)]
    assert words in complaint(seen) and bool(complaint(seen)) is bool(words)


def test_images_that_lack_and_a_robot_that_does_not_turn_say_nothing_wrong(walls: PhotoWalls) -> None:
    rng = np.random.default_rng(0)
    lacking = [
        replace(one, image=None) if lacks else one
        for one, lacks in zip(drive(walls, 1.0), rng.random(90) < 0.5, strict=True)
    ]
    assert not complaint(lacking)
    # The wheels turn and the image does not: they spin.
    spinning = [replace(one, odometry=Odometry(0.0, 0.05), image=walls.render(Pose2())) for one in lacking]
    assert not complaint(spinning)


@pytest.mark.parametrize("direction", [1.0, -1.0], ids=["ahead", "back"])
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["right", "reversed"])
def test_ways_with_the_wrong_sign_are_named(walls: PhotoWalls, direction: float, sign: float) -> None:
    """A robot may drive back; then the image moves back, too."""
    seen = drive(walls, 1.0, step=0.014)
    steps = [0.0, *(one.odometry.forward for one in seen[1:])]
    images = [one.image for one in seen]
    if direction < 0.0:
        images, steps = images[::-1], [0.0, *(-step for step in steps[:0:-1])]
    turns = [0.0, *(direction * one.odometry.turn for one in (seen[1:] if direction > 0.0 else seen[:0:-1]))]
    played = [
        replace(one, image=image, odometry=Odometry(sign * step, turn))
        for one, image, step, turn in zip(seen, images, steps, turns, strict=True)
    ]
    line = complaint(played)
    assert ("positive forward" in line) is (sign < 0.0) and REVERSED not in line


@pytest.mark.parametrize(("times", "word"), [(1.0, ""), (-1.0, REVERSED), (math.degrees(1.0), DEGREES)])
def test_a_robot_says_it_once(walls: PhotoWalls, times: float, word: str) -> None:
    pipeline = Pipeline(MapId("r0", 1), DESCRIPTION)
    pipeline.set_mission(Carried())
    for one in drive(walls, times):
        pipeline.step(one)
    lines = pipeline.complaints
    assert (len(lines) == 1 and word in lines[0]) if word else not lines
