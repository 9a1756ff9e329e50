"""The Create 2's driver against its Open Interface at the end of a pseudo-terminal."""

from typing import Any

import pytest

from mapweave import Command, Robot
from mapweave.agent.drivers.create import CreateBase
from mapweave.hybridmap.errors import DeviceError
from tests.agent.drivers.contract import RobotContract, drive, drive_until, drive_way, until
from tests.agent.drivers.emulators import ArduinoSketch, Create2


class TestCreate(RobotContract):
    DRIVER = "create"
    EMULATOR = Create2
    SPEED_STEP = 0.001
    COUNT = 0.45e-3 + 0.002

    def test_it_drives_on_after_it_was_lifted(self, robot: Robot, emulator: Any):
        drive(robot, Command(0.1, 0.0), 0.3)
        emulator.lift()
        until(lambda: emulator.wheels.speeds == (0.0, 0.0), 0.5)
        drive_until(robot, Command(0.1, 0.0), lambda: emulator.wheels.speeds[0] > 0.05)
        assert emulator.mode == 2

    def test_the_bumper_is_the_two_lowest_bits(self, robot: Robot, emulator: Any):
        for bumps, bumped in ((0b0000, False), (0b0001, True), (0b0010, True), (0b1100, False)):
            emulator.bumps = bumps
            seen = drive(robot, Command(), 0.3)
            assert seen[-1].bumped is bumped

    def test_both_wheels_drop_when_it_is_lifted(self, robot: Robot, emulator: Any):
        """Before, it did not say so, and the agent mapped on from where it had been."""
        for drops, lifted in ((0b0000, False), (0b0100, False), (0b1000, False), (0b1100, True), (0, False)):
            emulator.bumps = drops
            seen = drive(robot, Command(), 0.3)
            assert seen[-1].kidnapped is lifted

    def test_the_battery_is_a_share_of_its_capacity(self, robot: Robot, emulator: Any):
        assert drive(robot, Command(), 0.3)[-1].battery == pytest.approx(0.75)
        emulator.charge = 2700  # a new battery holds a little more than it says
        assert drive(robot, Command(), 0.3)[-1].battery == 1.0

    def test_counters_wrap_around(self, robot: Robot, emulator: Any):
        # 65536 counts are 29 m; a second before that.
        with emulator.wheels._lock:
            way = 65530 * 3.141592653589793 * 72e-3 / 508.8
        # What the counter says at the start is the past's.
        emulator.wheels._way = (way, way)
        drive(robot, Command(), 0.3)
        seen = drive_way(robot, Command(0.2, 0.0), 0.05)
        assert sum(o.odometry.forward for o in seen) < 0.15


def test_a_device_that_is_no_create_is_named(tmp_path, opened):
    """Ten bytes of whatever it sends were taken for encoders."""
    board = opened(ArduinoSketch(tmp_path))
    board.take = lambda data: None  # type: ignore[method-assign]
    base = opened(CreateBase(str(board.path)))
    with pytest.raises(DeviceError, match="no Create or Roomba answers so"):
        base.open()
