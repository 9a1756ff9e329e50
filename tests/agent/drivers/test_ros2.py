"""The ROS 2 driver against an emulated robot of a second implementation of the wire format."""

import logging
import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mapweave.agent.drivers.checked import CheckedRobot
from mapweave.agent.drivers.ros2 import Ros2
from mapweave.agent.drivers.ros2_odometry import WheelOdometry
from mapweave.agent.drivers.ros2_ranges import Ranger
from mapweave.agent.drivers.settings import CameraSettings, Geometry, RobotSettings
from mapweave.agent.observation import Command, Observation
from mapweave.agent.ros_messages.values import ODOMETRY_TYPE
from mapweave.hybridmap.errors import DeviceError, SettingsError
from mapweave.vision.equidistant import Equidistant
from mapweave.wire.ros2.messages import decode
from tests import ros2_peer as peer
from tests.agent.drivers.contract import HEIGHT, WIDTH, RobotContract, drive, drive_until, drive_way, until
from tests.agent.drivers.ros2_robot import KINDS, Ros2Robot
from tests.quick import first_quick
from tests.ros2_peer import RosPeer

Start = Callable[..., CheckedRobot]
KINDS_OF_COMMANDS = "geometry_msgs/msg/Twist"


def options_of(emulator: Ros2Robot, **options: Any) -> dict[str, Any]:
    return {
        "endpoint": emulator.endpoint, "image": "camera/image_raw", "bridge": emulator.bridge is not None,
        "namespace": emulator.bridge or "", **options,
    }  # fmt: skip


class TestRos2(RobotContract):
    DRIVER = "ros2"
    SPEED_STEP = 1e-9
    COUNT = 0.01
    """The newest message is a period old, in which a wheel goes 6 mm."""

    @pytest.fixture
    def emulator(self, tmp_path: Path, opened) -> Any:
        return opened(Ros2Robot())

    @pytest.fixture
    def settings(self, emulator: Any, tmp_path: Path) -> Path:
        path = tmp_path / "robot.toml"
        path.write_text(f"""
[robot]
driver = "ros2"
[robot.options]
endpoint = "{emulator.endpoint}"
image = "camera/image_raw"
ranges = ["scan", "range"]
[robot.geometry]
radius = 0.15
axle = 0.25
""")
        return path


@pytest.fixture
def start() -> Iterator[Start]:
    """Drivers of emulated robots; both end with the test."""
    robots: list[Any] = []

    def begin(emulator: Ros2Robot, camera: CameraSettings | None = None, **options: Any) -> CheckedRobot:
        settings = RobotSettings("ros2", options_of(emulator, **options), camera, Geometry(0.15, 0.25))
        robots.append(emulator)
        robots.append(CheckedRobot(Ros2(settings)))
        return robots[-1]

    yield begin
    for robot in reversed(robots):
        robot.close()


def last(robot: CheckedRobot, ticks: int = 3) -> Observation:
    seen = None
    for _ in range(ticks):
        seen = robot.sense()
    assert seen is not None
    return seen


def test_the_camera_is_what_the_robot_says(start: Start):
    emulator = Ros2Robot(lens={"lens": (0.1, -0.02, 0.001, 0.002, 0.003)})
    described = start(emulator).describe()
    camera = described.camera
    assert (camera.width, camera.height, camera.fx, camera.cx) == (WIDTH, HEIGHT, 60.0, WIDTH / 2)
    assert described.distortion == (0.1, -0.02, 0.001, 0.002, 0.003)
    # Base to camera link to optical frame; the floor is 5 cm below the base.
    assert camera.mount_forward == pytest.approx(0.07)
    assert camera.mount_height == pytest.approx(0.26)


def test_a_fisheye_lens_is_taken_from_camera_info(start: Start):
    emulator = Ros2Robot(lens={"model": "equidistant", "lens": (0.01, -0.002, 0.0, 0.0)})
    lens = start(emulator).describe().distortion
    assert isinstance(lens, Equidistant)
    assert (lens.fx, lens.k) == (60.0, (0.01, -0.002, 0.0, 0.0))


@pytest.mark.parametrize(
    ("odometry", "more"), [("joint_states", {"wheel_radius": 0.033}), ("wheel_ticks", {})]
)
@pytest.mark.parametrize("bridge", first_quick([None, "/bot1"], 1))
def test_other_odometry_compressed_images_and_stamped_commands(
    start: Start, odometry: str, more: dict[str, Any], bridge: str | None
):
    emulator = Ros2Robot(stamped=True, bridge=bridge)
    robot = start(emulator, image="camera/image_raw/compressed", odometry=odometry, **more)
    robot.sense()
    begin = emulator.wheels.way()
    seen: list[Observation] = []
    end = time.monotonic() + 20.0
    while sum(emulator.wheels.way()) - sum(begin) < 0.1:
        # On a busy machine it takes a while until the base hears the first command.
        assert time.monotonic() < end
        seen += drive(robot, Command(0.15, 0.6), 0.2)
    seen += drive(robot, Command(), 0.4)
    left, right = (b - a for a, b in zip(begin, emulator.wheels.way(), strict=True))
    assert sum(o.odometry.forward for o in seen) == pytest.approx((left + right) / 2, abs=0.01)
    assert sum(o.odometry.turn for o in seen) == pytest.approx((right - left) / 0.25, abs=0.08)
    assert sum(o.image is not None for o in seen) > len(seen) - 3


def test_a_scan_is_free_room_from_the_robots_edge(start: Start):
    emulator = Ros2Robot()
    robot = start(emulator, ranges=["scan"])
    described = robot.describe()
    assert len(described.ranger_bearings) == 24
    assert described.ranger_reach == 3.5
    # The scanner looks backwards, 3 cm behind the axle: its ray k points to 180 + 4 k degrees.
    walls = [math.inf] * 90
    walls[45], walls[22], walls[70], walls[0] = 1.03, 0.5, 0.09, 0.0
    emulator.walls = walls
    until(lambda: last(robot, 1).proximity.min() < 3.5, 5.0)
    seen = dict(zip(np.degrees(described.ranger_bearings).round(1), last(robot).proximity, strict=True))
    # Ahead, between two sectors: 1.03 m from the scanner, 1.0 m from the axle, 15 cm are the robot.
    assert seen[7.5] == seen[-7.5] == pytest.approx(0.85, abs=1e-6)
    x, y = 0.5 * math.cos(math.radians(268)) - 0.03, 0.5 * math.sin(math.radians(268))
    assert seen[-97.5] == pytest.approx(math.hypot(x, y) - 0.15, abs=1e-6)
    # What is nearer than the scanner can see, or part of the robot, is nothing.
    assert sorted(seen.values())[3] == 3.5


def test_bearings_near_to_each_other_have_rays_of_their_own():
    ranges = [2.0] * 360
    ranges[10] = 0.5
    data = peer.scan(0, "laser", 0.0, math.radians(1.0), 0.1, 3.5, ranges).bytes()
    message = decode("sensor_msgs/msg/LaserScan", data)
    ranger = Ranger("sensor_msgs/msg/LaserScan", message, None, 0.15)
    bearings = np.radians(np.arange(-175.0, 181.0, 5.0))
    near = ranger.distances(message, bearings) < 1.0
    assert np.degrees(bearings[near]).round() == pytest.approx([10.0])
    # Rays that are farther apart than bearings leave no bearing without one.
    few = decode("sensor_msgs/msg/LaserScan", peer.scan(0, "laser", 0.0, 0.2, 0.1, 3.5, [0.5] * 31).bytes())
    assert (ranger.distances(few, np.radians(np.arange(0.0, 340.0, 5.0))) < 1.0).all()


def test_range_and_infrared_sensors(start: Start):
    emulator = Ros2Robot()
    # At 10 cm in front of a bright surface the Create 3's sensor says 3500 exp(-26.8 * 0.1).
    emulator.infrared = [("ir_intensity_left", 239), ("ir_intensity_right", 5)]
    robot = start(emulator, ranges=["range", "ir_intensity"])
    described = robot.describe()
    assert described.ranger_bearings[0] == 0.0
    assert len(described.ranger_bearings) == 8
    proximity = last(robot).proximity
    names = [0.0, *(math.radians(b) for b in (75, 50, 25, 0, -25, -50, -75))]
    assert described.ranger_bearings == pytest.approx(names, abs=0.001)
    assert described.ranger_reach == 0.2
    assert proximity == pytest.approx([0.2, 0.2, 0.1, 0.2, 0.2, 0.2, 0.2, 0.2], abs=0.001)
    # The sensor is 3 cm inside the robot's outline.
    emulator.ranges = {"front": 0.08}
    until(lambda: last(robot, 1).proximity[0] == pytest.approx(0.05, abs=1e-6), 5.0)
    emulator.silent = {"range"}
    until(lambda: not len(last(robot, 1).proximity), 5.0)


def test_touch_and_being_lifted_are_reported(start: Start):
    emulator = Ros2Robot()
    robot = start(emulator)
    assert not last(robot).bumped
    emulator.hazards = [2, 5]
    assert not last(robot).bumped
    emulator.hazards = [1]
    until(lambda: last(robot, 1).bumped, 5.0)
    emulator.hazards, emulator.kidnapped = [], True
    until(lambda: last(robot, 1).kidnapped, 5.0)
    emulator.kidnapped = False
    until(lambda: not last(robot, 1).kidnapped, 5.0)
    assert last(robot, 1).battery is None
    emulator.battery = 0.625
    until(lambda: last(robot, 1).battery == 0.625, 5.0)


def test_another_clock_is_translated(start: Start):
    emulator = Ros2Robot()
    emulator.clock_ns = -1_700_000_000 * 10**9
    robot = start(emulator)
    seen = drive_way(robot, Command(0.2, 0.0), 0.05)
    assert abs(time.time_ns() - seen[-1].stamp_ns) < 1e9
    assert sum(o.image is not None for o in seen) > len(seen) - 3


@pytest.mark.parametrize(("given", "options", "line"), [
    ({"silent": ["odom"]}, {}, "no odometry on /odom"),
    ({"silent": ["image"]}, {}, "no images on /camera/image_raw; there are "),
    ({"silent": ["camera_info"]}, {}, r"no camera calibration \(\[robot.camera\] can replace it\)"),
    ({"silent": ["tf_static"]}, {}, "/tf_static does not tell where camera_optical_frame is"),
    ({}, {"odometry": "scan"}, "/scan has sensor_msgs/msg/LaserScan; odometry are nav_msgs"),
    ({}, {"odometry": "joint_states"}, "/joint_states: joint states need .* wheel_radius"),
    ({}, {"odometry": "joint_states", "wheel_radius": 0.03, "joints": ["fl", "fr"]},
     r"no joint 'fl' \(there are wheel_left_joint, wheel_right_joint\)"),
    ({"pose": [math.nan, 0.0, 0.0]}, {}, "/odom: odometry is not finite"),
    ({"lens": {"width": 128}}, {}, "images of 64x48 px, but /camera/camera_info is for 128x48"),
    ({"lens": {"model": "thin_prism"}}, {}, "/camera/camera_info: lens model 'thin_prism'"),
    ({"lens": {"focal": 0.0}}, {}, "focal lengths must be positive; calibrate it"),
    ({"encoding": "32FC1"}, {}, "/camera/image_raw: images of encoding '32FC1'"),
])  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(
    start: Start, given: dict[str, Any], options: dict[str, Any], line: str, monkeypatch
):
    monkeypatch.setattr("mapweave.agent.drivers.wheeled.PATIENCE", 0.1)
    monkeypatch.setattr("mapweave.agent.drivers.wheeled.RETRY", 0.05)
    monkeypatch.setattr("mapweave.agent.drivers.ros2.PATIENCE", 0.3)
    robot = start(Ros2Robot(**given), **options)

    # First it finds no router, and then messages one by one.
    def said() -> bool:
        with pytest.raises(DeviceError) as error:
            robot.describe()
        assert "\n" not in str(error.value)
        return re.search(line, str(error.value)) is not None

    until(said, 10.0)


def test_odometry_without_orientation_is_refused():
    """Its heading was taken for 0."""
    zeros = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    message = SimpleNamespace(pose=SimpleNamespace(pose=SimpleNamespace(position=zeros, orientation=zeros)))
    with pytest.raises(DeviceError, match="its quaternion is all zeros"):
        WheelOdometry(0.25, None, ("left", "right")).update(ODOMETRY_TYPE, message, 0)


def test_settings_are_checked_before_anything_moves(start: Start):
    with pytest.raises(SettingsError, match="axle is missing"):
        Ros2(RobotSettings("ros2", {}, geometry=Geometry(radius=0.15)))
    with pytest.raises(SettingsError, match="endpoint"):
        Ros2(RobotSettings("ros2", {"endpoint": "robot.local"}))


def test_without_a_router_one_line_says_so(monkeypatch, opened):
    monkeypatch.setattr("mapweave.agent.drivers.wheeled.PATIENCE", 1.0)
    monkeypatch.setattr("mapweave.agent.drivers.ros2.PATIENCE", 0.3)
    robot = opened(Ros2(RobotSettings("ros2", {"endpoint": "tcp/127.0.0.1:9"}, None, Geometry(0.15, 0.25))))
    with pytest.raises(DeviceError, match=r"no router at tcp/127\.0\.0\.1:9"):
        robot.describe()


@pytest.mark.parametrize(("degrees", "lens", "words"), first_quick([
    (2.0, {}, ""),
    (12.0, {}, "the camera looks 12 deg down by tf"),
    (0.0, {"lens": (-0.1, 0.02, 0.001)}, "3 coefficients of distortion"),
    (-12.0, {}, "the camera looks 12 deg up by tf"),
    (0.0, {}, ""),
], 3))  # fmt: skip
def test_what_is_not_taken_into_account_of_a_camera_is_said(
    start: Start, caplog, degrees: float, lens: dict[str, Any], words: str
):
    """Its heading was said alone, and the pitch of recordings."""
    half = math.radians(degrees) / 2.0
    robot = start(Ros2Robot(camera=(0.0, math.sin(half), 0.0, math.cos(half)), lens=lens))
    with caplog.at_level(logging.WARNING):
        robot.describe()
    lines = [record.message for record in caplog.records]
    assert len(lines) == bool(words)
    assert all(line.startswith("/camera/camera_info: ") and words in line for line in lines)


def test_that_odometry_has_two_publishers_is_said(start: Start, caplog):
    """The steps between their poses were taken for slip, or the robot for one that stands."""
    emulator = Ros2Robot()
    robot = start(emulator)
    robot.describe()
    other = RosPeer(emulator.endpoint)
    try:
        with caplog.at_level(logging.WARNING):
            other.publisher("/odom", KINDS["odom"])
            until(lambda: bool(caplog.records), 10.0)
    finally:
        other.close()
    (line,) = [record.message for record in caplog.records]
    assert line.startswith("/odom has 2 publishers, whose poses are mixed")


def test_that_no_node_listens_is_said_once(start: Start, caplog):
    emulator = Ros2Robot()
    robot = start(emulator, command="drive")
    with caplog.at_level(logging.WARNING):
        # It stood before, and so there was nothing to say.
        drive(robot, Command(), 0.1)
        drive_until(robot, Command(0.1, 0.0), lambda: bool(caplog.records))
        drive(robot, Command(0.1, 0.0), 0.1)
    assert [r.message for r in caplog.records] == ["no node subscribes to drive: the robot does not move"]


@pytest.mark.parametrize("bridge", first_quick([None, "/bot1"], 1))
def test_a_second_agent_of_one_robot_is_refused_and_says_nothing_to_the_wheels(
    start: Start, bridge: str | None, monkeypatch
):
    """Agents of two names drove one robot, each against the other."""
    emulator = Ros2Robot(bridge=bridge)
    first = start(emulator)
    first.describe()
    drive_until(first, Command(0.1, 0.0), lambda: emulator.wheels.way()[0] > 0.03)
    refused, said, published = threading.Event(), list[str](), list[Command]()

    def begin() -> None:
        second: Any = start(emulator)
        monkeypatch.setattr(second._robot._ros, "publish", published.append)
        # On a busy machine no message may have come before: it is asked again.
        while not (said and "another agent" in said[-1]):
            try:
                second.describe()
                said.append("another agent was not found")
            except DeviceError as error:
                said.append(str(error))
        second.close()
        refused.set()

    threading.Thread(target=begin, daemon=True).start()
    drive_until(first, Command(0.1, 0.0), refused.is_set, 30.0)
    assert said[-1].startswith(f"another agent drives the robot by {bridge or ''}/cmd_vel; stop it")
    assert not published, "not even that the wheels shall stop: they are those of the first"
    way = emulator.wheels.way()[0]
    drive_until(first, Command(0.1, 0.0), lambda: emulator.wheels.way()[0] > way + 0.03)
    first.close()
    third = start(emulator)

    def described() -> bool:
        try:
            return third.describe().camera.width == WIDTH
        except DeviceError as error:
            assert "another agent" not in str(error), "the first has left"
            return False

    until(described, 30.0)


def test_others_who_publish_commands_are_named(start: Start, caplog, opened):
    """A person's teleoperation, or Nav2: no reason to refuse."""
    emulator = Ros2Robot()
    robot = start(emulator)
    robot.describe()
    assert "another publisher" not in caplog.text
    other = opened(RosPeer(emulator.endpoint))
    other.publisher("/cmd_vel", KINDS_OF_COMMANDS)
    until(lambda: "/cmd_vel has another publisher, which drives the robot, too" in caplog.text, 10.0)
    assert robot.sense() is not None
