"""The examples are short; the own driver passes the contract, the remote base answers an agent."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from mapweave.agent.drivers.checked import CheckedRobot
from mapweave.agent.drivers.remote import RemoteRobot
from mapweave.agent.observation import Command
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from tests.agent.drivers.contract import RobotContract
from tests.agent.drivers.emulators import LineEmulator
from tests.waiting import free_port

EXAMPLES = Path(__file__).parents[3] / "examples"


class Board(LineEmulator):
    """The motor board that examples/own_robot.py describes."""

    def switched_on(self) -> None:
        super().switched_on()
        self.wheels.set(0.0, 0.0)
        self._last = time.monotonic()

    def line(self, line: str) -> None:
        match line.split():
            case ["V", left, right]:
                self._last = time.monotonic()
                self.wheels.set(int(left) / 1000, int(right) / 1000)
            case ["R"]:
                left, right = (round(way / 0.0002) for way in self.wheels.way())
                self.say(f"R {left} {right}\r\n".encode())

    def idle(self) -> None:
        if time.monotonic() - self._last > 0.25 and self.wheels.speeds != (0.0, 0.0):
            self.wheels.set(0.0, 0.0)


class TestOwnRobot(RobotContract):
    DRIVER = f"{EXAMPLES / 'own_robot.py'}:OwnRobot"
    EMULATOR = Board
    SPEED_STEP = 0.001
    COUNT = 0.2e-3 + 0.002


def test_they_are_short():
    assert len((EXAMPLES / "own_robot.py").read_text().splitlines()) <= 30


def test_the_remote_base_answers_an_agent():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = ZenohBus(BusSettings(mode="router", listen=(endpoint,)))
    body = subprocess.Popen([sys.executable, EXAMPLES / "remote_base.py", endpoint])
    try:
        robot = CheckedRobot(RemoteRobot(router, "demo", "r0", patience=20.0))
        assert robot.describe().camera.width == 320
        first = robot.sense()
        robot.act(Command(0.2, 0.5))
        second = robot.sense()
        assert first is not None
        assert second is not None
        assert second.odometry.forward == pytest.approx(0.02)
        assert second.odometry.turn == pytest.approx(0.05)
        assert second.image is not None
        assert second.image.shape == (240, 320)
        robot.close()
    finally:
        body.kill()
        body.wait()
        router.close()


def test_the_remote_base_without_a_router_ends_in_one_line():
    """Zenoh's traceback named a file of its author's computer."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ran = subprocess.run(
        [sys.executable, EXAMPLES / "remote_base.py", endpoint],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ran.stderr == f"no router at {endpoint}: start `mapweave server`, or give the router's address\n"
    assert ran.returncode == 1
