"""The Waveshare UGV's driver over a pseudo-terminal and over HTTP."""

import json
import os
import pty
import subprocess
import sys
import threading
import tty
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from mapweave import Command, Robot
from mapweave.agent.drivers.base import Wheels
from mapweave.agent.drivers.settings import CameraSettings, RobotSettings
from mapweave.agent.drivers.waveshare import HttpLine, SerialLine, Waveshare, WaveshareBase
from mapweave.hybridmap.errors import DeviceError, SettingsError
from tests.agent.drivers.contract import RobotContract, drive, drive_until
from tests.agent.drivers.waveshare_emulators import UgvHttp, UgvSerial
from tests.programs import going
from tests.waiting import free_port


class TestUgvSerial(RobotContract):
    DRIVER = "waveshare"
    EMULATOR = UgvSerial
    SPEED_STEP = 0.001
    # Speeds are summed: a change of speed between two answers is half seen.
    COUNT = 0.02

    def test_it_shortens_the_watchdog_before_it_drives(self, robot: Robot, emulator: Any):
        drive(robot, Command(0.1, 0.0), 0.2)
        sent = [json.loads(line) for line in emulator.heard.splitlines()]
        moves = [k for k, command in enumerate(sent) if command["T"] == 1 and command["L"]]
        assert {"T": 136, "cmd": 300} in sent[: moves[0]]

    def test_a_line_that_is_cut_off_is_passed_over(self, robot: Robot, emulator: Any):
        emulator.say(b'{"T":1001,"L":0.1\r\n\xff\xfe{}\r\n')
        drive_until(robot, Command(0.1, 0.0), lambda: emulator.wheels.speeds[0] > 0.05)


def test_odometers_go_before_speeds(tmp_path, video: Path, opened):
    """Firmware ugv_base_ros: `odl`, `odr` in centimetres."""
    ugv = opened(UgvSerial(tmp_path, odometers=True))
    camera = CameraSettings(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3, source=str(video))
    robot = opened(Waveshare(RobotSettings(options={"port": str(ugv.path)}, camera=camera)))
    robot.sense()
    seen = drive(robot, Command(0.2, 0.5), 1.0)
    seen += drive(robot, Command(), 0.3)
    left, right = ugv.wheels.way()
    assert sum(o.odometry.forward for o in seen) == pytest.approx((left + right) / 2, abs=0.01)
    assert sum(o.odometry.turn for o in seen) == pytest.approx((right - left) / 0.172, abs=0.06)


def test_a_base_that_streams_something_else_is_named(tmp_path):
    """Before, its lines were read for ever, and no command went out."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    done = threading.Event()

    def chatter() -> None:
        while not done.wait(0.02):
            os.write(master, b'{"T":1003,"mac":"x"}\n')

    thread = threading.Thread(target=chatter)
    thread.start()
    line = SerialLine(os.ttyname(slave))
    try:
        with pytest.raises(DeviceError, match="is not what a UGV's base streams"):
            line.feedback()
    finally:
        done.set()
        thread.join()
        line.close()
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize("port", ["http://", "http://127.0.0.1:abc", "https://192.168.4.1", "http://h:99999"])
def test_an_address_that_is_none(port: str):
    with pytest.raises(SettingsError, match="neither a serial device nor http://ADDRESS"):
        Waveshare(RobotSettings(options={"port": port}))


def test_an_address_where_no_robot_is():
    address = f"http://127.0.0.1:{free_port()}"
    with pytest.raises(
        DeviceError, match=f"^{address}: Connection refused; is the robot switched on, and this"
    ):
        HttpLine(address).feedback()


def test_a_second_driver_at_an_address_is_refused_and_leaves_the_wheels_alone(tmp_path):
    """By any name that the address has. Agents of other names would each drive the robot."""
    ugv = UgvHttp(tmp_path)
    first, second = WaveshareBase(ugv.path), WaveshareBase(ugv.path.replace("127.0.0.1", "localhost"))
    try:
        first.open()
        first.drive(Wheels(0.2, 0.2))
        with pytest.raises(DeviceError, match=f"^{ugv.path}: is in use by another process$"):
            second.open()
        second.close()
        assert ugv.wheels.speeds == (0.2, 0.2)
        first.close()
        second.open()
    finally:
        first.close()
        second.close()
        ugv.close()


def test_a_driver_in_another_process_is_refused_until_the_first_has_ended(tmp_path):
    ugv = UgvHttp(tmp_path)
    program = (
        "import sys, time; from mapweave.agent.drivers.waveshare import WaveshareBase\n"
        f"base = WaveshareBase({ugv.path!r}); base.open(); print(1, flush=True); time.sleep(60)"
    )
    with closing(ugv), closing(WaveshareBase(ugv.path)) as base:
        with going(sys.executable, "-c", program, stdout=subprocess.PIPE) as holder:
            assert holder.stdout is not None
            assert holder.stdout.read(1) == b"1"
            with pytest.raises(DeviceError, match="is in use by another process"):
                base.open()
        base.open()


class TestUgvHttp(RobotContract):
    DRIVER = "waveshare"
    EMULATOR = UgvHttp
    SPEED_STEP = 0.001
    COUNT = 0.02
