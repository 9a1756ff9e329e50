"""The Koala's driver against a Koala of each generation at the end of a pseudo-terminal."""

import math
from typing import Any

import numpy as np

from mapweave.agent.drivers.robot import Robot
from tests.agent.drivers.contract import RobotContract, until
from tests.agent.drivers.emulators import Koala25, KoalaSilver


class TestKoalaSilver(RobotContract):
    DRIVER = "koala"
    EMULATOR = KoalaSilver
    SPEED_STEP = 0.0045
    COUNT = 0.045e-3 + 0.002

    def test_infrared_values_become_distances(self, robot: Robot, emulator: Any):
        emulator.infrared = [0, 1023, 80, 20] + [5] * 12
        for _ in range(3):
            seen = robot.sense()
        assert seen is not None
        reach = robot.describe().ranger_reach
        assert len(seen.proximity) == len(robot.describe().ranger_bearings) == 16
        # Four times the light comes back from half the distance.
        np.testing.assert_allclose(seen.proximity[[0, 2, 3]], [reach, reach / 2, reach])
        assert 0.0 < seen.proximity[1] < 0.03


class TestKoala25(RobotContract):
    DRIVER = "koala"
    EMULATOR = Koala25
    SPEED_STEP = 0.0012
    COUNT = 1.2e-5 + 0.002

    def test_ultrasonic_values_become_distances(self, robot: Robot, emulator: Any):
        # Manual, 4.1: 0 below 25 cm, 25 to 250 cm, 1000 for nothing, 2000 for a sensor that is off.
        emulator.ultrasonic = [0, 25, 130, 250, 1000, 2000, 1000, 1000, 1000]
        for _ in range(3):
            seen = robot.sense()
        assert seen is not None
        np.testing.assert_allclose(seen.proximity[:5], [0.0, 0.25, 1.3, 2.5, 2.5])
        assert math.isnan(seen.proximity[5])

    def test_the_first_sensors_are_on_the_left(self, robot: Robot):
        bearings = np.degrees(robot.describe().ranger_bearings)
        # Manual, command G: left rear, left front, front left, front, ... back right, back left.
        assert (bearings[:3] > 0).all()
        assert bearings[3] == 0.0
        assert (bearings[4:8] < 0).all()

    def test_wheels_stand_before_the_first_command(self, robot: Robot, emulator: Any):
        until(lambda: b"D,0,0" in emulator.heard, 1.0)
        assert emulator.wheels.way() == (0.0, 0.0)
