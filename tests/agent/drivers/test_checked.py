"""Each mistake of a driver's author is one line at the first observation that shows it."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapweave import Camera, Command, Observation, Odometry, RobotDescription
from mapweave.agent.drivers.checked import FIRST, CheckedRobot
from mapweave.hybridmap.errors import DeviceError

DESCRIPTION = RobotDescription(
    Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3), ranger_bearings=(-0.5, 0.0, 0.5, 1.0, 1.5), ranger_reach=2.0
)
NOW_S = 1_795_000_000.0
NOW_NS = round(NOW_S * 1e9)
GOOD = Observation(NOW_NS, Odometry(0.01, 0.0), np.zeros((48, 64), np.uint8), np.full(5, 1.0))


class Scripted:
    """A driver that does as the test says."""

    def __init__(self, *seen: Any, description: Any = DESCRIPTION, applied: Any = None) -> None:
        self.seen = list(seen)
        self.description = description
        self.applied = applied

    def describe(self) -> Any:
        return self.description

    def sense(self) -> Any:
        return self.seen.pop(0)

    def act(self, command: Command) -> Any:
        return self.applied

    def close(self) -> None:
        self.closed = True


def checked(*seen: Any, **rest: Any) -> CheckedRobot:
    return CheckedRobot(Scripted(*seen, **rest), clock=lambda: NOW_S)


def good(**changes: Any) -> Observation:
    return replace(GOOD, **changes)


@pytest.mark.parametrize(("seen", "words"), [
    (good(image=np.zeros((48, 64, 3), np.uint8)), "image has 3 channels; it must be grey"),
    (good(image=np.zeros((48, 64), np.float32)), r"image must be \(H, W\) uint8, not .* float32"),
    (good(image=np.zeros((480, 640), np.uint8)), "image is 640x480 px, but .* described as 64x48"),
    (good(image="frame.png"), "image must be an array, not str"),
    (good(stamp_ns=time.time()), "stamp_ns .* is float; it must be whole nanoseconds"),
    (good(stamp_ns=round(NOW_S)), "stamp_ns 1795000000 are seconds since 1970; it must be nanoseconds"),
    (good(stamp_ns=round(NOW_S * 1e3)), "stamp_ns .* are milliseconds since 1970"),
    (good(stamp_ns=round(NOW_S * 1e6)), "stamp_ns .* are microseconds since 1970"),
    (good(odometry=Odometry(math.nan, 0.0)), "odometry is not finite: nan m, 0 rad"),
    (good(odometry=Odometry(0.0, math.inf)), "odometry is not finite"),
    (good(proximity=np.ones(4)), r"proximity has 4 readings, but describe\(\) gives 5 ranger_bearings"),
    (good(proximity=np.ones((5, 2))), "proximity must be an array of one distance for each bearing"),
    (good(odometry=None), "odometry must be an Odometry, not None"),
    (good(odometry=(0.1, 0.0)), "odometry must be an Odometry, not tuple"),
    (good(odometry=Odometry("0.1", 0.0)), "odometry must be two numbers, m and rad, not '0.1' and 0.0"),  # type: ignore[arg-type]
    (good(odometry=Odometry(1e300, 0.0)), "odometry is no motion in a tick: 1e\\+300 m, 0 rad"),
    (good(bumped=None), "bumped must be True or False, not None"),
    (good(kidnapped=1), "kidnapped must be True or False, not 1"),
    (good(proximity=[1.0] * 5), "proximity must be an array, not list"),
    (good(proximity=np.full(5, "1")), "proximity must be an array of one distance for each bearing"),
    (good(battery=80), "battery is 80; it must be a share from 0 to 1, or None"),
    (good(battery="full"), "battery is 'full'; it must be a share from 0 to 1, or None"),
    ((GOOD,), r"sense\(\) must return an Observation or None, not tuple"),
])  # fmt: skip
def test_a_wrong_observation(seen: Any, words: str):
    with pytest.raises(DeviceError, match=f"^driver: {words}") as error:
        checked(seen).sense()
    assert "\n" not in str(error.value)


def test_five_readings_and_no_bearings():
    robot = checked(GOOD, description=replace(DESCRIPTION, ranger_bearings=()))
    with pytest.raises(DeviceError, match=r"5 readings, but describe\(\) gives 0 ranger_bearings"):
        robot.sense()


def test_readings_in_centimetres_and_what_tells_nothing_of_the_unit():
    with pytest.raises(DeviceError, match=r"proximity reads 30, but describe.* ranger_reach 2 m; both are m"):
        checked(good(proximity=np.array([2.0, np.inf, 30.0, 0.1, 0.0]))).sense()
    robot = checked(
        good(proximity=np.array([2.0, np.inf, np.nan, 8.0, 0.0])),
        good(stamp_ns=NOW_NS + 10**8, proximity=np.full(5, 655.35)),
    )
    assert robot.sense() and robot.sense()


def test_a_driver_that_returns_none_has_ended_the_agent_which_is_said(caplog):
    """As for "no frame yet": the agent ended with status 0 and without a word."""
    caplog.set_level("INFO")
    assert checked(GOOD).sense() and not caplog.messages
    assert checked(None).sense() is None
    assert caplog.messages == [
        "no more observations (the driver's sense() has returned None): the agent ends"
    ]


def test_bearings_in_degrees():
    robot = checked(GOOD, description=replace(DESCRIPTION, ranger_bearings=(0.0, 45.0, 90.0)))
    with pytest.raises(DeviceError, match="ranger_bearings are radians, not degrees: 45"):
        robot.sense()


@pytest.mark.parametrize(("changes", "words"), [
    ({"ranger_bearings": np.zeros(2)}, "ranger_bearings must be a tuple of radians, not ndarray"),
    ({"axle": None}, r"gives no robot description: Expected `float`, got `null` - at `\$.axle`"),
    ({"tick": 0.0}, r"gives no robot description: Expected `float` >= 0.0001 - at `\$.tick`"),
])  # fmt: skip
def test_a_wrong_description(changes: dict[str, Any], words: str):
    with pytest.raises(DeviceError, match=rf"^driver: describe\(\) {words}"):
        checked(description=replace(DESCRIPTION, **changes)).describe()


class Raises(Scripted):
    """A driver each of whose methods has a mistake."""

    def describe(self) -> Any:
        return {}["camera"]

    def sense(self) -> Any:
        return np.zeros(3).reshape(2, 2)

    def act(self, command: Command) -> Any:
        return command.left  # type: ignore[attr-defined]

    def close(self) -> None:
        raise OSError("no\nport")


@pytest.mark.parametrize(("call", "words"), [
    (lambda robot: robot.describe(), "KeyError: 'camera'"),
    (lambda robot: robot.sense(), "ValueError: cannot reshape array of size 3"),
    (lambda robot: robot.act(Command()), "AttributeError: 'Command' object has no attribute 'left'"),
])  # fmt: skip
def test_an_error_of_the_drivers_own_code_names_its_file_and_line(
    call: Callable[[CheckedRobot], object], words: str, monkeypatch
):
    if "KeyError" not in words:
        monkeypatch.setattr(Raises, "describe", lambda self: DESCRIPTION)
    with pytest.raises(DeviceError, match=rf"^driver: {__file__}, line \d+: {words}") as error:
        call(CheckedRobot(Raises()))
    assert "\n" not in str(error.value)


def test_a_driver_that_fails_to_close_is_logged(caplog):
    CheckedRobot(Raises()).close()
    assert [record.getMessage().partition(": OSError")[2] for record in caplog.records] == [": no port"]


def test_a_mistake_of_this_package_is_not_blamed_on_the_driver():
    robot = checked(GOOD)
    robot._robot = None  # type: ignore[assignment]
    with pytest.raises(AttributeError):
        robot.describe()


def test_a_description_that_is_none():
    with pytest.raises(DeviceError, match=r"describe\(\) must return a RobotDescription, not dict"):
        checked(description={}).describe()


@pytest.mark.parametrize(("first", "second", "words"), [
    (NOW_NS, NOW_NS, "stamp_ns stands still"),
    (NOW_NS, NOW_NS - 1, "stamp_ns goes backwards, from 1795000000000000000 to 1794999999999999999"),
    (NOW_NS, NOW_NS + 100, "stamp_ns rises by 100 in a tick of 0.1 s; it must be nanoseconds"),
    (0, 1, "must be nanoseconds"),  # seconds since the start
])  # fmt: skip
def test_stamps_that_do_not_rise_as_they_should(first: int, second: int, words: str):
    robot = checked(good(stamp_ns=first), good(stamp_ns=second))
    robot.sense()
    with pytest.raises(DeviceError, match=words):
        robot.sense()


def test_a_clock_that_fails_later_is_for_the_pipeline_to_say():
    stamps = [*(NOW_NS + k * 100_000_000 for k in range(FIRST + 1)), NOW_NS, NOW_NS, NOW_NS + 3600 * 10**9]
    robot = checked(*(good(stamp_ns=stamp) for stamp in stamps))
    assert [robot.sense().stamp_ns for _ in stamps] == stamps  # type: ignore[union-attr]


@pytest.mark.parametrize("in_a_second", [1.0, 1e3, 1e6])
def test_a_clock_since_the_start_passes_other_units_since_1970(in_a_second: float):
    """After 1795 s, or 21 days, a count of nanoseconds is that of milli- or microseconds since 1970.

    Before, the agent of a robot with such a clock ended half an hour after the start.
    """
    middle = round(NOW_S * in_a_second)
    stamps = [middle + k * 100_000_000 for k in range(-12, 13)]
    robot = checked(*(good(stamp_ns=stamp) for stamp in stamps))
    assert [robot.sense().stamp_ns for _ in stamps] == stamps  # type: ignore[union-attr]


def at(tick: int, forward: float, turn: float = 0.0) -> Observation:
    """A good observation with a motion."""
    return good(stamp_ns=NOW_NS + tick * 100_000_000, odometry=Odometry(forward, turn))


@pytest.mark.parametrize(("motion", "words"), [
    (Odometry(30.0, 0.0), "30 m in 0.1 s, but .* at most 0.3 m/s"),  # millimetres
    (Odometry(0.0, -4.5), "-4.5 rad in 0.1 s, but .* at most 0.8 rad/s"),  # degrees
])  # fmt: skip
def test_odometry_in_another_unit_shows_when_the_robot_first_moves(motion: Odometry, words: str):
    robot = checked(at(0, 0.0), *(at(k, 0.0) for k in range(1, 40)), replace(at(40, 0.0), odometry=motion))
    for _ in range(40):
        robot.sense()
    with pytest.raises(DeviceError, match=f"^driver: odometry is {words}; .* since the observation before"):
        robot.sense()


def test_encoders_that_jump_later_are_for_the_pipeline_to_say():
    seen = [*(at(k, 0.01) for k in range(FIRST + 1)), at(FIRST + 1, 30.0)]
    robot = checked(*seen)
    assert [robot.sense() for _ in seen] == seen


def test_a_robot_that_is_pushed_or_late_moves_as_it_may():
    """The way of a minute without an observation, and a robot without limits, which is carried."""
    seen = [at(0, 0.0), at(1, 0.4, 0.8), at(601, 30.0)]
    robot = checked(*seen)
    assert [robot.sense() for _ in seen] == seen
    carried = checked(at(0, 0.0), at(1, 5.0), description=replace(DESCRIPTION, max_forward=0.0))
    assert carried.sense() is not None
    assert carried.sense() is not None


@pytest.mark.parametrize(("applied", "words"), [
    (None, "must return the Command that is applied, not None"),
    ((0.1, 0.0), "not tuple"),
    (Command(math.nan, 0.0), "is not finite"),
])  # fmt: skip
def test_act_without_an_answer(applied: Any, words: str):
    with pytest.raises(DeviceError, match=rf"^driver: act\(\) .*{words}"):
        checked(applied=applied).act(Command())


class ClosedMeanwhile(Scripted):
    """A stop signal closes it while it reads, or before it is commanded."""

    def sense(self) -> Any:
        self.robot.close()
        raise OSError(9, "Bad file descriptor")

    def act(self, command: Command) -> Any:
        raise OSError(9, "Bad file descriptor")


def test_a_driver_that_fails_as_it_is_closed_has_ended():
    driver = ClosedMeanwhile()
    driver.robot = CheckedRobot(driver)
    with pytest.raises(DeviceError, match="Bad file descriptor"):
        driver.robot.act(Command())
    assert driver.robot.sense() is None
    assert driver.robot.act(Command(0.1, 0.0)) == Command()


def test_a_good_robot_passes_through():
    blind = good(stamp_ns=NOW_NS + 100_000_000, image=None, proximity=np.zeros(0))
    later = good(stamp_ns=np.int64(NOW_NS + 200_000_000), proximity=np.full(5, np.nan))
    robot = checked(GOOD, blind, later, None, applied=Command(0.1, 0.0))
    assert robot.describe() is DESCRIPTION
    assert [robot.sense() for _ in range(4)] == [GOOD, blind, later, None]
    assert robot.act(Command(0.5, 0.0)) == Command(0.1, 0.0)


def test_a_simulation_that_begins_at_zero_is_no_mistake():
    robot = CheckedRobot(Scripted(*(good(stamp_ns=k * 100_000_000) for k in range(50))))
    for _ in range(50):
        assert robot.sense() is not None
