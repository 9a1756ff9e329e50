"""A base and a camera as one robot: odometry at the time of the image, whatever fails."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from mapweave.agent.drivers import wheeled
from mapweave.agent.drivers.base import BaseReading, WheelCounter, Wheels
from mapweave.agent.drivers.camera import StampedImage
from mapweave.agent.drivers.checked import CheckedRobot
from mapweave.agent.drivers.clock import now_ns
from mapweave.agent.drivers.settings import CameraSettings, Geometry, RobotSettings
from mapweave.agent.drivers.wheeled import WheeledRobot
from mapweave.agent.observation import Command
from mapweave.hybridmap.errors import DeviceError
from tests.waiting import eventually

SETTINGS = RobotSettings(camera=CameraSettings(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3))
IMAGE = np.zeros((48, 64), np.uint8)
SPEED = Wheels(0.2, 0.3)


class EvenBase:
    """Wheels that have always driven evenly: their way is the time."""

    geometry = Geometry(radius=0.1, axle=0.25, max_forward=0.3, max_turn=0.8)

    def __init__(self) -> None:
        self.failing = self.broken = self.stamped = False
        self.touches = self.reads = 0
        self.answers = threading.Event()
        self.answers.set()

    def way(self, stamp_ns: int) -> Wheels:
        seconds = (stamp_ns % 10**13) / 1e9
        return Wheels(SPEED.left * seconds, SPEED.right * seconds)

    def open(self) -> None:
        if self.failing:
            raise DeviceError("gone")

    def close(self) -> None:
        pass

    def nearest(self, speeds: Wheels) -> Wheels:
        return speeds

    def drive(self, speeds: Wheels) -> None:
        if self.broken:
            raise ValueError("a mistake in the driver")

    def read(self) -> BaseReading:
        if self.failing:
            raise DeviceError("gone")
        self.answers.wait()
        self.reads += 1
        touched, self.touches = self.touches > 0, max(self.touches - 1, 0)
        now = now_ns()
        stamp = now if self.stamped else None
        return BaseReading(self.way(now), stamp_ns=stamp, bumped=touched, kidnapped=touched)


class LateCamera:
    """Frames that come a while after they were taken."""

    def __init__(self, delay: float) -> None:
        self.delay = delay
        self.silent = False

    def newer(self, stamp_ns: int, patience: float) -> StampedImage | None:
        end = time.monotonic() + patience
        while time.monotonic() < end:
            taken = now_ns() - round(self.delay * 1e9)
            if taken > stamp_ns and not self.silent:
                return StampedImage(taken, IMAGE)
            time.sleep(0.005)
        return None

    def close(self) -> None:
        pass


@pytest.fixture
def base() -> EvenBase:
    return EvenBase()


@pytest.fixture
def camera() -> LateCamera:
    return LateCamera(0.13)


@pytest.fixture
def robot(base: EvenBase, camera: LateCamera) -> Iterator[CheckedRobot]:
    robot = CheckedRobot(WheeledRobot(base, SETTINGS, camera))
    for _ in range(3):
        # Images from before the base has answered first: nothing is known of its way then.
        robot.sense()
    yield robot
    robot.close()


def test_odometry_is_that_of_the_time_between_the_images(monkeypatch, opened):
    """The wheels' way is that of the middle of the base's answer. Time passes with its answers alone."""
    passed = [10**15]

    class Answers(EvenBase):
        def read(self) -> BaseReading:
            half = 5_000_000 if self.reads % 2 else 25_000_000
            passed[0] += half
            reading = super().read()
            passed[0] += half
            return reading

    for module in (wheeled, sys.modules[__name__]):
        monkeypatch.setattr(module, "now_ns", lambda: passed[0])
    robot = opened(CheckedRobot(WheeledRobot(Answers(), SETTINGS, LateCamera(0.13))))
    # Those before are images from before the base has answered first.
    eventually(lambda: (seen := robot.sense()) is not None and seen.odometry.forward > 0.0)
    first = robot.sense()
    for _ in range(10):
        assert first is not None
        second = robot.sense()
        assert second is not None
        seconds = (second.stamp_ns - first.stamp_ns) / 1e9
        assert second.odometry.forward == pytest.approx(0.25 * seconds, abs=1e-6)
        assert second.odometry.turn == pytest.approx(0.1 / 0.25 * seconds, abs=1e-5)
        first = second


def test_a_touch_between_two_observations_is_not_lost(robot: CheckedRobot, base: EvenBase):
    quiet = robot.sense()
    base.touches, base.reads = 1, 0
    eventually(lambda: base.reads >= 3)  # The last two touch nothing.
    touched, after = robot.sense(), robot.sense()
    assert quiet is not None
    assert touched is not None
    assert after is not None
    assert [seen.bumped for seen in (quiet, touched, after)] == [False, True, False]
    assert [seen.kidnapped for seen in (quiet, touched, after)] == [False, True, False]


def test_ticks_without_image_and_images_after_them(robot: CheckedRobot, base: EvenBase, camera: LateCamera):
    # Else what a busy machine does between the reading and the clock would count.
    base.stamped, base.reads = True, 0
    eventually(lambda: base.reads >= 3)
    robot.sense()
    seen = [robot.sense() for _ in range(3)]
    camera.silent = True
    seen += [robot.sense() for _ in range(5)]
    camera.silent = False
    seen += [robot.sense() for _ in range(4)]
    observations = [o for o in seen if o is not None]
    assert len(observations) == 12
    assert all(o.image is None for o in observations[3:8])
    assert all(o.image is not None for o in observations[9:])
    stamps = [o.stamp_ns for o in observations]
    assert min(np.diff(stamps)) > 1e6
    whole = 0.25 * (stamps[-1] - stamps[0]) / 1e9
    assert sum(o.odometry.forward for o in observations[1:]) == pytest.approx(whole, abs=1e-3)


def test_neither_image_nor_wheels(robot: CheckedRobot, base: EvenBase, camera: LateCamera):
    robot.sense()
    camera.silent = base.failing = True
    begin = time.monotonic()
    for _ in range(6):
        seen = robot.sense()
        assert seen is not None
    assert time.monotonic() - begin < 1.6
    assert seen is not None
    assert seen.odometry.forward == 0.0
    camera.silent = base.failing = False
    time.sleep(0.5)
    for _ in range(3):
        seen = robot.sense()
    assert seen is not None
    assert seen.image is not None


def test_a_base_that_waits_on_for_an_answer_is_called_silent(
    robot: CheckedRobot, base: EvenBase, monkeypatch, caplog
):
    monkeypatch.setattr(wheeled, "SILENT", 0.3)
    base.answers.clear()
    with caplog.at_level("WARNING"):
        for _ in range(8):
            seen = robot.sense()
        base.answers.set()
        eventually(lambda: "the robot answers again" in caplog.text)
    assert seen is not None and seen.odometry.forward == 0.0
    assert seen.silent == "the robot's base has not answered for 0.3 s", "who is far away reads no log"
    after = robot.sense()
    assert after is not None and after.silent == ""
    assert [record.message for record in caplog.records] == [
        "the robot's base has not answered for 0.3 s; the robot stands until it answers again",
        "the robot answers again",
    ]


def test_a_driver_that_fails_is_not_driven_on(robot: CheckedRobot, base: EvenBase):
    robot.sense()
    base.broken = True
    with pytest.raises(DeviceError, match=rf"^driver: {__file__}, line \d+: ValueError: a mistake"):
        for _ in range(5):
            robot.act(Command(0.1, 0.0))
            robot.sense()


class Reads(EvenBase):
    """A base whose `read` does what a test says."""

    def __init__(self, read: Callable[[], Any]) -> None:
        super().__init__()
        self.read = read  # type: ignore[method-assign]


@pytest.mark.parametrize(("read", "words"), [
    (lambda: None, r"read\(\) must return a BaseReading, not None"),
    (lambda: BaseReading((0.0, 0.0)), r"read\(\): way must be Wheels, not tuple"),  # type: ignore[arg-type]
    (lambda: BaseReading(Wheels("1", "2")), r"read\(\): way must be two finite numbers, not '1' and '2'"),  # type: ignore[arg-type]
    (lambda: BaseReading(Wheels(), bumped=None), r"read\(\): bumped must be True or False, not None"),  # type: ignore[arg-type]
    (
        lambda: BaseReading(Wheels(), stamp_ns=1_700_000_000),
        r"read\(\): stamp_ns is 1700000000; it must be",
    ),
    (lambda: BaseReading(Wheels(), stamp_ns=1.7e18), r"read\(\): stamp_ns is 1.7e\+18; it must be"),  # type: ignore[arg-type]
    (lambda: 1 / 0, r".*test_wheeled.py, line \d+: ZeroDivisionError"),
    (lambda: sys.exit("no board"), r".*test_wheeled.py, line \d+: SystemExit: no board"),
])  # fmt: skip
def test_a_base_that_reads_wrongly_from_the_start(
    read: Callable[[], Any], words: str, camera: LateCamera, monkeypatch, opened
):
    # It is not waited for: that would take longer than any test may.
    monkeypatch.setattr(wheeled, "PATIENCE", 600.0)
    robot = opened(CheckedRobot(WheeledRobot(Reads(read), SETTINGS, camera)))
    begin = time.monotonic()
    with pytest.raises(DeviceError, match=f"^driver: {words}"):
        robot.sense()
    assert time.monotonic() - begin < 4.0


def test_a_base_that_cannot_be_closed_is_not_forgotten(
    base: EvenBase, camera: LateCamera, monkeypatch, opened
):
    monkeypatch.setattr(base, "close", lambda: {}["port"])
    base.failing = True
    robot = opened(WheeledRobot(base, SETTINGS, camera))
    with pytest.raises(DeviceError, match=r"^driver: .*test_wheeled.py, line \d+: KeyError: 'port'"):
        robot.sense()


def test_a_base_that_never_answers_is_not_called_closed(camera: LateCamera, monkeypatch, opened):
    monkeypatch.setattr("mapweave.agent.drivers.wheeled.PATIENCE", 0.2)
    ended = threading.Event()
    robot = opened(WheeledRobot(Reads(ended.wait), SETTINGS, camera))
    with pytest.raises(DeviceError, match=r"^the robot's base has not answered for 0.2 s"):
        robot.sense()
    ended.set()


def test_a_base_without_a_method_or_a_class_is_refused(camera: LateCamera, monkeypatch):
    with pytest.raises(DeviceError, match=r"^driver: base is the class EvenBase; it must be an object"):
        WheeledRobot(EvenBase, SETTINGS, camera)  # type: ignore[arg-type]
    monkeypatch.delattr(EvenBase, "read")
    with pytest.raises(DeviceError, match=r"^driver: base EvenBase needs open, .*; it lacks read$"):
        WheeledRobot(EvenBase(), SETTINGS, camera)


def test_speeds_geometry_and_frames_of_another_type(
    base: EvenBase, robot: CheckedRobot, camera: LateCamera, monkeypatch, opened
):
    monkeypatch.setattr(base, "nearest", lambda speeds: tuple(speeds))
    with pytest.raises(DeviceError, match=r"^driver: nearest\(\) must be Wheels, not tuple"):
        robot.act(Command(0.1, 0.0))
    monkeypatch.setattr(camera, "newer", lambda stamp_ns, patience: IMAGE)
    with pytest.raises(
        DeviceError, match=r"^driver: camera: newer\(\) must return a Frame or None, not ndarray"
    ):
        robot.sense()
    nameless = EvenBase()
    nameless.geometry = None  # type: ignore[assignment]
    other = opened(CheckedRobot(WheeledRobot(nameless, SETTINGS, camera)))
    with pytest.raises(DeviceError, match=r"^driver: geometry of the base must be a Geometry, not None"):
        other.describe()


def test_a_base_that_is_not_there_is_one_line(base: EvenBase, camera: LateCamera, monkeypatch, opened):
    monkeypatch.setattr("mapweave.agent.drivers.wheeled.PATIENCE", 0.5)
    base.failing = True
    robot = opened(WheeledRobot(base, SETTINGS, camera))
    with pytest.raises(DeviceError, match=r"^gone$"):
        robot.sense()


def test_a_counter_that_wraps_or_is_set_back():
    counter = WheelCounter(0.001, bits=16, fastest=1.0)
    ways = [counter.update(count, 0.1 * k) for k, count in enumerate([65500, 65530, 24, 54, 10, 40, 65530])]
    assert ways == pytest.approx([0.0, 0.030, 0.060, 0.090, 0.046, 0.076, 0.030])
    restarted = WheelCounter(0.001, bits=32, fastest=1.0)
    ways = [restarted.update(count, 0.1 * k) for k, count in enumerate([100_000, 100_050, 0, 50])]
    assert ways == pytest.approx([0.0, 0.05, 0.05, 0.10])
