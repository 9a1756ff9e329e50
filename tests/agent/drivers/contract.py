"""What every driver promises, as a class to derive tests from: give the robot and its emulator.

The limits in time are the contract's; a busy machine gets what `SLACK` says on top.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from mapweave.agent.drivers.checked import CheckedRobot
from mapweave.agent.drivers.robot import Robot
from mapweave.agent.drivers.settings import RobotSettings
from mapweave.agent.observation import Command, Observation
from mapweave.hybridmap.errors import InvalidValue
from tests.programs import going
from tests.recordings import write_video
from tests.waiting import eventually

ROOT = Path(__file__).parents[3]
WIDTH, HEIGHT = 64, 48
STOPS_WITHIN = 0.5
"""s after the last command, or after the death of the process."""
ANSWERS_WITHIN = 0.02
"""s that `act` may take, and `sense` beyond two ticks."""
SLACK = 0.03
"""s; processes and threads of a busy machine wait for their turn."""

CHILD = """
import sys, time
from pathlib import Path
from mapweave.agent.drivers.registry import find_driver
from mapweave.agent.observation import Command
from mapweave.settings import load_settings
path = Path(sys.argv[1])
settings = load_settings(path).robot
robot = find_driver(settings.driver)(settings)
while True:
    robot.sense()
    robot.act(Command(0.2, 0.0))
    print("driving", flush=True)
"""


def noise_video(path: Path, seconds: int) -> Path:
    """A video of noise at 20 frames a second."""
    noise = np.random.default_rng(0)
    frames = [noise.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(4)]
    return write_video(path, frames * 5 * seconds, 20.0)


def until(happened: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, f"did not happen within {seconds:g} s"
        time.sleep(0.002)


def drive(robot: Robot, command: Command, seconds: float) -> list[Observation]:
    """Let the robot drive; returns what it saw after each command."""
    seen = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        robot.act(command)
        observation = robot.sense()
        assert observation is not None
        seen.append(observation)
    return seen


def drive_until(
    robot: Robot, command: Command, happened: Callable[[], bool], seconds: float = 10.0
) -> list[Observation]:
    """Let the robot drive until something has happened, however long a busy machine takes."""
    seen: list[Observation] = []
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, f"did not happen within {seconds:g} s of driving"
        seen += drive(robot, command, 0.001)
    return seen


def drive_way(robot: Robot, command: Command, way: float) -> list[Observation]:
    """Let the robot drive until it has driven `way`, m, forward by its odometry."""
    seen: list[Observation] = []
    while sum(observation.odometry.forward for observation in seen) < way:
        before = len(seen)
        seen += drive(robot, command, 0.001)
        assert before < 500, f"did not drive {way:g} m"
    return seen


class RobotContract:
    """Derive from it, and give `DRIVER`, `EMULATOR` and the other values."""

    DRIVER: str
    EMULATOR: Callable[[Path], Any]
    """Makes the emulator in a folder."""
    SPEED_STEP: float
    """Of a wheel, m/s: what the robot's command can say."""
    COUNT: float
    """Way of a wheel for a step of what it reads, m."""
    CHILD: ClassVar[str] = CHILD
    """A program that drives the robot of the settings that it is given, for ever."""
    OPTIONS: ClassVar[dict[str, Any]] = {}
    GEOMETRY: ClassVar[dict[str, Any]] = {}

    @pytest.fixture
    def emulator(self, tmp_path: Path) -> Iterator[Any]:
        with closing(self.EMULATOR(tmp_path)) as emulator:
            yield emulator

    @pytest.fixture
    def settings(self, emulator: Any, tmp_path: Path, video: Path) -> Path:
        def table(values: dict[str, Any]) -> str:
            return "\n".join(f"{name} = {value!r}" for name, value in values.items())

        camera = {
            "source": str(video), "width": WIDTH, "height": HEIGHT, "fx": 60.0, "fy": 60.0, "cx": 32.0,
            "cy": 24.0, "height_m": 0.3,
        }  # fmt: skip
        options = {"port": str(emulator.path), **self.OPTIONS}
        path = tmp_path / "robot.toml"
        path.write_text(
            f"[robot]\ndriver = {self.DRIVER!r}\n[robot.camera]\n{table(camera)}\n"
            f"[robot.options]\n{table(options)}\n[robot.geometry]\n{table(self.GEOMETRY)}\n"
        )
        return path

    @pytest.fixture
    def robot(self, settings: Path) -> Iterator[Robot]:
        from mapweave.agent.drivers.registry import find_driver
        from mapweave.settings import load_settings

        given: RobotSettings = load_settings(settings).robot
        robot = CheckedRobot(find_driver(given.driver)(given))
        robot.describe()
        yield robot
        robot.close()

    def test_odometry_is_in_metres_and_radians(self, robot: Robot, emulator: Any):
        robot.sense()
        start = emulator.wheels.way()
        axle = robot.describe().axle

        def driven() -> tuple[float, float]:
            left, right = (b - a for a, b in zip(start, emulator.wheels.way(), strict=True))
            return (left + right) / 2, (right - left) / axle

        seen = drive_way(robot, Command(0.2, 0.0), 0.12)
        seen += drive_until(robot, Command(0.1, 0.5), lambda: driven()[1] > 0.3)
        seen += drive_until(robot, Command(), lambda: emulator.wheels.speeds == (0.0, 0.0))
        error = 2 * self.COUNT

        def known() -> bool:
            forward, turn = (sum(getattr(o.odometry, name) for o in seen) for name in ("forward", "turn"))
            off = abs(forward - driven()[0]), abs(turn - driven()[1])
            return off[0] < error and off[1] < 2 * error / axle

        # Images are older than the wheels, by more on a busy machine.
        eventually(lambda: known() or seen.extend(drive(robot, Command(), 0.1)))
        assert driven()[0] > 0.15

    def test_stamps_are_nanoseconds_that_rise_with_the_images(self, robot: Robot):
        seen = drive(robot, Command(), 1.5)
        now, tick = time.time_ns(), robot.describe().tick
        stamps = [observation.stamp_ns for observation in seen]
        assert 0 <= now - stamps[-1] < 1e9
        steps = np.diff(stamps) / 1e9
        assert (steps > 0).all()
        assert np.median(steps) == pytest.approx(tick, abs=0.03)
        images = [observation.image for observation in seen]
        assert sum(image is not None for image in images) >= len(images) - 2
        assert all(i.shape == (HEIGHT, WIDTH) and i.dtype == np.uint8 for i in images if i is not None)

    def test_act_returns_what_the_wheels_do(self, robot: Robot, emulator: Any):
        description = robot.describe()
        axle = description.axle
        for wanted in (Command(0.1234, 0.321), Command(-0.05, 0.1), Command(99.0, -99.0)):
            before = len(emulator.wheels.commanded)
            applied = robot.act(wanted)
            left, right = applied.forward - applied.turn * axle / 2, applied.forward + applied.turn * axle / 2
            # It is given again, as an agent does: a network may lose one before it knows who listens.
            drive_until(
                robot,
                wanted,
                lambda before=before, speeds=(left, right): any(
                    commanded == pytest.approx(speeds, abs=1e-9)
                    for commanded in emulator.wheels.commanded[before:]
                ),
            )
            limited = min(abs(wanted.forward), description.max_forward)
            assert abs(applied.forward) == pytest.approx(limited, abs=self.SPEED_STEP)
            assert abs(applied.turn) <= description.max_turn + 2 * self.SPEED_STEP / axle
        with pytest.raises(InvalidValue, match="finite"):
            robot.act(Command(float("nan"), 0.0))

    def test_wheels_stop_when_commands_cease(self, robot: Robot, emulator: Any):
        drive_until(robot, Command(0.2, 0.0), lambda: emulator.wheels.speeds[0] > 0.1)
        last = time.monotonic()
        until(lambda: emulator.wheels.speeds == (0.0, 0.0), 1.5)
        assert emulator.wheels.stopped_at - last < STOPS_WITHIN + SLACK
        # It drives on with the next command.
        drive_until(robot, Command(0.2, 0.0), lambda: emulator.wheels.speeds[0] > 0.1)

    def test_wheels_stop_when_it_is_closed(self, robot: Robot, emulator: Any):
        drive_until(robot, Command(0.2, 0.0), lambda: emulator.wheels.speeds[0] > 0.1)
        robot.close()
        until(lambda: emulator.wheels.speeds == (0.0, 0.0), STOPS_WITHIN)
        assert robot.sense() is None

    def test_wheels_stop_when_the_process_hangs_or_dies(self, settings: Path, emulator: Any):
        program, paths = [sys.executable, "-c", self.CHILD, settings], {"PYTHONPATH": str(ROOT)}
        with going(*program, stdout=subprocess.PIPE, cwd=ROOT, env=os.environ | paths) as child:
            assert child.stdout is not None
            for _ in range(3):
                assert child.stdout.readline() == b"driving\n"
            for end in (signal.SIGSTOP, signal.SIGKILL):
                until(lambda: emulator.wheels.speeds[0] > 0.1, 1.0)
                child.send_signal(end)
                ended = time.monotonic()
                until(lambda: emulator.wheels.speeds == (0.0, 0.0), 1.5)
                assert emulator.wheels.stopped_at - ended < STOPS_WITHIN + SLACK
                child.send_signal(signal.SIGCONT)

    def test_it_comes_back_when_the_port_has_vanished(self, robot: Robot, emulator: Any):
        drive_until(robot, Command(0.2, 0.0), lambda: emulator.wheels.speeds[0] > 0.1)
        emulator.unplug()
        gone = drive(robot, Command(0.2, 0.0), 0.8)
        assert sum(o.odometry.forward for o in gone[4:]) == pytest.approx(0.0, abs=1e-9)
        assert not len(gone[-1].proximity)
        emulator.plug_in()
        drive_until(robot, Command(0.2, 0.0), lambda: emulator.wheels.speeds[0] > 0.1)
        back = drive_way(robot, Command(0.2, 0.0), 0.05)
        assert len(back[-1].proximity) == len(robot.describe().ranger_bearings)

    def test_a_stalled_line_holds_up_nothing(self, robot: Robot, emulator: Any):
        drive(robot, Command(0.1, 0.0), 0.3)
        emulator.stalled = True
        tick, acts, senses = robot.describe().tick, [], []
        for _ in range(12):
            begin = time.monotonic()
            robot.act(Command(0.1, 0.0))
            acts.append(time.monotonic() - begin)
            begin = time.monotonic()
            robot.sense()
            senses.append(time.monotonic() - begin)
        emulator.stalled = False
        # The median: a machine that does other things as well may hold up a single call.
        assert np.median(acts) < ANSWERS_WITHIN
        assert np.median(senses) < 2 * tick + ANSWERS_WITHIN
        assert max(acts) < 0.25
        drive_until(robot, Command(0.1, 0.0), lambda: emulator.wheels.speeds[0] > 0.05)
