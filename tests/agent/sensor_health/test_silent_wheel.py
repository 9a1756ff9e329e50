"""Which encoder is dead is said of a robot that is driven by hand, and nothing in a turn about a wheel."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave import MapId, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.mission import Carried
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.sensor_health.silent_wheel import SilentWheel
from tests.agent.conftest import DESCRIPTION, PhotoWalls

ROBOT = replace(DESCRIPTION, axle=0.3)
WALLS = PhotoWalls()


def ticks(steps: list[tuple[float, float]], dead: str = "", start: Pose2 | None = None) -> list[Observation]:
    """A robot whose left and right wheels make these ways, m; one encoder may count nothing."""
    pose, out = start or Pose2(-1.0), []
    for k, (left, right) in enumerate(steps):
        pose = pose @ Odometry(0.5 * (left + right), (right - left) / ROBOT.axle).motion()
        left, right = 0.0 if dead == "left" else left, 0.0 if dead == "right" else right
        odometry = Odometry(0.5 * (left + right), (right - left) / ROBOT.axle)
        out.append(Observation((k + 1) * 100_000_000, odometry, WALLS.render(pose)))
    return out


def complaint(observed: list[Observation], robot: RobotDescription = ROBOT) -> str:
    watch = SilentWheel(robot)
    for observation in observed:
        watch.see(observation)
    return watch.complaint


STRAIGHT = [(0.02, 0.02)] * 40
WEAVE = [(0.02 + 0.006 * math.sin(0.3 * k), 0.02 - 0.006 * math.sin(0.3 * k)) for k in range(50)]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("steps", [STRAIGHT, WEAVE])
def test_the_encoder_that_is_dead_is_named(steps: list[tuple[float, float]], side: str):
    words = complaint(ticks(steps, side))
    assert words == (
        f"the {side} encoder counts nothing while the image shows that its wheel turns: check its cable"
    )


@pytest.mark.parametrize("steps", [
    STRAIGHT, WEAVE, [(0.0, 0.02)] * 8 + [(0.0, -0.02)] * 16 + [(0.0, 0.02)] * 16, [(0.0, 0.0)] * 40,
])  # fmt: skip
def test_encoders_that_count_are_believed_also_in_a_turn_about_a_wheel(steps: list[tuple[float, float]]):
    assert not complaint(ticks(steps))


def test_a_wheel_that_spins_in_place_is_no_dead_encoder():
    """The image stands: the other wheel stands too, as its encoder says."""
    still = [replace(one, image=WALLS.render(Pose2(-1.0))) for one in ticks([(0.0, 0.03)] * 40)]
    assert not complaint(still)


def test_images_that_show_nothing_say_nothing():
    blank = [replace(one, image=np.full((240, 320), 90, np.uint8)) for one in ticks(STRAIGHT, "left")]
    assert not complaint(blank)
    assert not complaint([replace(one, image=None) for one in ticks(STRAIGHT, "left")])


def test_a_pipeline_names_it_and_blames_no_clock():
    """It used to be named as odometry that turns late, if at all."""
    pipeline = Pipeline(MapId("r0", 1), ROBOT)
    pipeline.set_mission(Carried())
    for observation in ticks(STRAIGHT, "left"):
        pipeline.step(observation)
    (line,) = pipeline.complaints
    assert line.startswith("the map is wrong: the left encoder counts nothing")
