"""Free room around the footprint by the proximity sensors."""

import math

import numpy as np
import pytest

from mapweave import Camera, RobotDescription
from mapweave.agent.clearance import BEFORE, clearance

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)
BEARINGS = tuple(math.radians(b) for b in range(0, 360, 10))


@pytest.mark.parametrize("reach", [0.2, 3.0])
def test_a_wall_within_reach_is_kept_clear_of(reach: float):
    robot = RobotDescription(CAMERA, radius=0.16, ranger_bearings=BEARINGS, ranger_reach=reach)
    # A wall ahead at 0.15 m from the edge, seen by every ray that meets it within reach.
    ahead = 0.31 / np.maximum(np.cos(BEARINGS), 1e-9) - 0.16
    proximity = np.minimum(ahead, reach)
    assert clearance(robot, proximity, 0.0, 0.6) == pytest.approx(0.15 - BEFORE)
    assert clearance(robot, proximity, math.pi, 0.6) == pytest.approx(max(reach - BEFORE, 0.6), abs=0.05)


def test_nothing_within_a_short_reach_is_as_good_as_no_sensor():
    short = RobotDescription(CAMERA, radius=0.16, ranger_bearings=BEARINGS, ranger_reach=0.2)
    none = RobotDescription(CAMERA, radius=0.16)
    for unknown in (0.0, 0.6):
        free = clearance(short, np.full(36, 0.2), 0.0, unknown)
        assert free >= clearance(none, np.zeros(0), 0.0, unknown) == unknown


def test_room_within_a_long_reach_is_what_was_measured():
    robot = RobotDescription(CAMERA, radius=0.16, ranger_bearings=(0.0,), ranger_reach=3.0)
    assert clearance(robot, np.array([3.0]), 0.0, 0.6) == pytest.approx(3.0 - BEFORE)
    assert clearance(robot, np.array([1.0]), 0.0, 0.6) == pytest.approx(1.0 - BEFORE)
    assert clearance(robot, np.array([1.0]), 1.5, 0.6) == 0.6
