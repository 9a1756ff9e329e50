"""Unit and signs of odometry, held against the image."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave import Camera, Observation, Odometry, Pose2
from mapweave.agent.sensor_health import odometry_convention
from mapweave.agent.sensor_health.odometry_convention import OdometryConvention
from mapweave.agent.vision.visual_odometry import VisualMotion, visual_motion
from tests.agent.conftest import CAMERA, PhotoWalls

REVERSED, DEGREES = "the other way", "in degrees"


@pytest.fixture(scope="module", autouse=True)
def compared_once() -> Iterator[None]:
    """The same images are held against many odometries: two of them are compared with each other once."""
    known: dict[tuple[bytes, bytes, Camera], VisualMotion | None] = {}

    def compared(before: NDArray[np.uint8], now: NDArray[np.uint8], camera: Camera) -> VisualMotion | None:
        key = before.tobytes(), now.tobytes(), camera
        if key not in known:
            known[key] = visual_motion(before, now, camera)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(odometry_convention, "visual_motion", compared)
        yield


def drive(
    walls: PhotoWalls, times: float, every: int = 1, step: float = 0.01, count: int = 90
) -> list[Observation]:
    """Swings to both sides and drives ahead; wheels that report so many times the turn."""
    poses = [Pose2(step * k, 0.0, 0.25 * math.sin(0.15 * k)) for k in range(0, count, every)]
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
@pytest.mark.parametrize(("times", "words"), [
    (1.0, ()), (0.8, ()), (1.25, ()), (0.0, ()), (5.0, ()), (-1.0, (REVERSED,)),
    (math.degrees(1.0), (DEGREES,)), (-math.degrees(1.0), (DEGREES, REVERSED)),
])  # fmt: skip
def test_a_wrong_unit_or_sign_is_named_and_a_wrong_scale_is_not(
    walls: PhotoWalls, every: int, times: float, words: tuple[str, ...]
):
    line = complaint(drive(walls, times, every))
    assert bool(line) is bool(words) and "\n" not in line
    for word in (REVERSED, DEGREES):
        assert (word in line) is (word in words), line


@pytest.mark.parametrize(("turned", "words"), [
    (lambda image: image[:, ::-1], "mirrored"),
    (lambda image: image[::-1, ::-1], "upside down"),
    (lambda image: image, ""),
], ids=["mirrored", "upside down", "right"])  # fmt: skip
def test_an_image_that_is_mirrored_or_upside_down_turns_the_other_way(walls, turned, words: str):
    seen = [replace(one, image=np.ascontiguousarray(turned(one.image))) for one in drive(walls, 1.0)]
    line = complaint(seen)
    assert words in line and bool(line) is bool(words)


def test_images_that_lack_and_a_robot_that_does_not_turn_say_nothing_wrong(walls: PhotoWalls):
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
def test_ways_with_the_wrong_sign_are_named(walls: PhotoWalls, direction: float, sign: float):
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


def sideways(image: NDArray[np.uint8], times: int) -> NDArray[np.uint8]:
    """Turned by so many times 90 degrees to the left, and cut to its old size."""
    turned = np.rot90(image, times)
    height, width = turned.shape
    rows, columns = min(height, image.shape[0]), min(width, image.shape[1])
    out = np.full(image.shape, 128, np.uint8)
    out[:rows, 40 : 40 + columns] = turned[40 : 40 + rows, :columns]
    return out


def furnished(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A grey image of a few boxes that are not where they are in any other."""
    image = np.full(shape, 128, np.uint8)
    for _ in range(25):
        (x, y), (width, height) = rng.integers(0, shape[::-1]), rng.integers(20, 80, 2)
        image[y : y + height, x : x + width] = rng.integers(0, 256)
    return image


def spoilt(seen: list[Observation], how: str) -> list[Observation]:
    """A drive of which something is wrong."""
    rows = [(one.odometry.forward, one.odometry.turn) for one in seen]
    images: list[NDArray[np.uint8]] = [one.image for one in seen if one.image is not None]
    late, rng = [(0.0, 0.0)] * 10, np.random.default_rng(0)
    if how == "late":
        rows = [*late, *rows[:-10]]
    elif how == "early":
        rows = [*rows[10:], *late]
    elif how == "exchanged":
        rows = [(turn, forward) for forward, turn in rows]
    elif how == "rates":
        rows = [(10.0 * forward, 10.0 * turn) for forward, turn in rows]
    elif how == "centimetres":
        rows = [(100.0 * forward, turn) for forward, turn in rows]
    elif how.startswith("to the"):
        images = [sideways(image, 1 if how == "to the left" else 3) for image in images]
    elif how == "another drive":
        images = [furnished(rng, image.shape) for image in images]
    elif how == "dark":
        electrons = rng.poisson(4.0, 1 << 16).astype(np.uint8)
        images = [electrons[rng.integers(0, len(electrons), image.shape, np.uint16)] for image in images]
    odometry = [Odometry(*row) for row in rows]
    return [replace(a, odometry=b, image=c) for a, b, c in zip(seen, odometry, images, strict=True)]


@pytest.mark.parametrize(("how", "words"), [
    ("right", ()), ("dark", ()), ("late", ("the odometry turns 1.0 s after the images",)),
    ("early", ("the images turn 1.0 s after the odometry",)),
    ("exchanged", ("columns of ways and turns are exchanged",)),
    ("rates", ("turns 10 times as far", "in rad/s and must be in radians since the", "speeds?")),
    ("centimetres", ("times as low as the floor", "in centimetres")),
    ("to the left", ("turned by 90 degrees",)), ("to the right", ("turned by 90 degrees",)),
    ("another drive", ("show nothing in common", "in the wrong order")),
])  # fmt: skip
def test_the_likeliest_cause_is_named_and_no_other(walls: PhotoWalls, how: str, words: tuple[str, ...]):
    line = complaint(spoilt(drive(walls, 1.0, count=150), how))
    assert all(word in line for word in words), line
    assert bool(line) is bool(words)
    causes = (REVERSED, DEGREES, "exchanged", "90 degrees", "one clock", "common", "centimetres", "rad/s")
    assert sum(cause in line for cause in causes) <= max(len(words), 1), line


def test_a_clock_that_goes_back_begins_again(walls: PhotoWalls):
    seen = spoilt(drive(walls, 1.0, count=150), "late")
    assert not complaint([*seen[:40], *seen[:40]])
    assert "1.0 s after" in complaint([*seen[:40], *seen])
