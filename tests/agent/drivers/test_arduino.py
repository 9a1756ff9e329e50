"""The driver for any Arduino against the protocol of docs/arduino.md at the end of a pseudo-terminal."""

from typing import Any

import numpy as np

from mapweave import Command, Robot
from tests.agent.drivers.contract import RobotContract, drive, drive_until
from tests.agent.drivers.emulators import ArduinoSketch


class TestArduino(RobotContract):
    DRIVER = "arduino"
    EMULATOR = ArduinoSketch
    SPEED_STEP = 0.001
    COUNT = 0.2e-3 + 0.005
    OPTIONS = {"wheel_radius": 0.033, "counts_per_turn": 1440}  # noqa: RUF012
    GEOMETRY = {  # noqa: RUF012
        "radius": 0.12, "axle": 0.15, "ranger_bearings_deg": [45.0, 0.0, -45.0], "ranger_reach": 1.5,
    }  # fmt: skip

    def test_distances_and_bumper(self, robot: Robot, emulator: Any):
        emulator.bumped = 1
        seen = drive(robot, Command(), 0.3)[-1]
        # 200 cm are beyond the reach, -1 is nothing.
        np.testing.assert_allclose(seen.proximity, [1.5, 1.5, 0.15])
        assert seen.bumped

    def test_lines_that_are_no_lines_are_passed_over(self, robot: Robot, emulator: Any):
        emulator.say(b"S 12 x\nrubbish\n\n")
        drive_until(robot, Command(0.1, 0.0), lambda: emulator.wheels.speeds[0] > 0.05)
