"""Robots that speak ROS 2, over rmw_zenoh or zenoh-bridge-ros2dds; this computer needs no ROS."""

import logging
import math
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.drivers import ros2_odometry, ros2_ranges
from mapweave.agent.drivers.base import BaseReading, Wheels
from mapweave.agent.drivers.claim import Claim
from mapweave.agent.drivers.clock import RemoteClock, now_ns
from mapweave.agent.drivers.ros2_guard import Ros2Guard
from mapweave.agent.drivers.ros2_odometry import WheelOdometry
from mapweave.agent.drivers.ros2_ranges import Ranger
from mapweave.agent.drivers.ros2_topics import Mounts, NewestMessage, Ros2Camera
from mapweave.agent.drivers.settings import CameraSettings, Geometry, RobotSettings
from mapweave.agent.drivers.wheeled import STALE, WheeledRobot
from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.recordings.camera_info_check import doubts
from mapweave.agent.ros_messages import making
from mapweave.agent.ros_messages.images import grey_of
from mapweave.agent.ros_messages.values import (
    BASE,
    CAMERA_TYPE,
    IMAGE_TYPES,
    KIDNAP_TYPE,
    ODOMETRY_TYPE,
    camera_of,
)
from mapweave.hybridmap.errors import DeviceError, InvalidValue, SettingsError
from mapweave.wire.bus_settings import LEASE
from mapweave.wire.ros2.keys import CommandKeys, Endpoint, EndpointRole
from mapweave.wire.ros2.messages import encode, make
from mapweave.wire.ros2.node import Publisher, Ros2Node
from mapweave.wire.ros2.settings import Ros2Link

log = logging.getLogger(__name__)

NODE = "mapweave_driver"
KNOWN = Geometry(max_forward=0.2, max_turn=0.8)
"""Slow enough for all common robots; a TurtleBot 3 Burger drives 0.22 m/s."""
PATIENCE = 1.0
"""s that a first message of each topic is waited for, in each attempt to begin."""
HAZARDS_TYPE = "irobot_create_msgs/msg/HazardDetectionVector"
BATTERY_TYPE = "sensor_msgs/msg/BatteryState"
BUMP, STALL = 1, 3
"""Types of HazardDetection that mean touch."""
TWIST_TYPE, STAMPED_TYPE = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


@dataclass(frozen=True)
class Ros2Options(Ros2Link):
    """The table `[robot.options]`.

    Attributes:
        endpoint: see Ros2Link.
        domain: see Ros2Link.
        namespace: see Ros2Link.
        bridge: see Ros2Link.
        image: topic of the images, raw or compressed.
        camera_info: topic of the camera's calibration; by default `camera_info` beside the images. Not read
            if there is a [robot.camera].
        height_m: of the camera above the floor, if /tf_static does not tell where it is.
        forward_m: how far the camera is ahead of the axle; likewise.
        odometry: topic of Odometry, JointState, or the Create 3's WheelTicks.
        wheel_radius: m; for JointState, and for WheelTicks of other wheels than the Create 3's.
        joints: of the left and right wheel, for JointState.
        ranges: topics of LaserScan, Range, or the Create 3's IrIntensityVector.
        command: topic that drives the robot, Twist or TwistStamped, as the robot subscribes.
    """

    image: str = "image_raw"
    camera_info: str = ""
    height_m: float | None = None
    forward_m: float = 0.0
    odometry: str = "odom"
    wheel_radius: float | None = None
    joints: tuple[str, str] = ("wheel_left_joint", "wheel_right_joint")
    ranges: tuple[str, ...] = ()
    command: str = "cmd_vel"


class Ros2Base:
    """Wheels and sensors behind topics. A guard process stops the wheels.

    Attributes:
        geometry: dimensions and limits, ranger bearings included once it is open.
        camera: calibration and mount, once it is open.
    """

    def __init__(self, node: Ros2Node, options: Ros2Options, settings: RobotSettings) -> None:
        """Subscribe.

        Raises:
            SettingsError: a dimension of the robot is missing.
        """
        given = settings.geometry.over(KNOWN)
        for name in ("radius", "axle"):
            if getattr(given, name) is None:
                raise SettingsError(f"[robot.geometry] {name} is missing: the driver cannot know it")
        assert given.radius is not None
        assert given.axle is not None
        self.geometry, self.camera = KNOWN, settings.camera
        self._node, self._options, self._given = node, options, given
        self._axle, self._radius = given.axle, given.radius
        self._clock = clock = RemoteClock()
        self._odometry = NewestMessage(node, options.odometry, ros2_odometry.KINDS, clock)
        self._sources = set[str]()
        node.watch(EndpointRole.PUBLISHER, self._odometry.name, self._odometry_source)
        self._wheels = WheelOdometry(given.axle, options.wheel_radius, options.joints)
        self.images = NewestMessage(node, options.image, IMAGE_TYPES, clock)
        beside = options.image.removesuffix("/compressed").rpartition("/")
        info = options.camera_info or f"{beside[0]}{beside[1]}camera_info"
        self._info = None if self.camera is not None else NewestMessage(node, info, (CAMERA_TYPE,), None)
        self._rectified = beside[2].startswith("image_rect")
        self._mounts = Mounts(node)
        self._ranges = [NewestMessage(node, name, ros2_ranges.KINDS, clock) for name in options.ranges]
        self._rangers: list[Ranger] = []
        self._kidnap = NewestMessage(node, "kidnap_status", (KIDNAP_TYPE,), clock)
        self._battery = NewestMessage(node, "battery_state", (BATTERY_TYPE,), clock)
        self._hazards = NewestMessage(node, "hazard_detection", (HAZARDS_TYPE,), clock)
        topic = node.link.topic(options.command)
        self._twist, self._stamped = (node.publisher(topic, kind) for kind in (TWIST_TYPE, STAMPED_TYPE))
        self._subscribed: list[Publisher] = []
        self._command = topic
        node.watch(EndpointRole.PUBLISHER, topic, self._command_source)
        self._claim: Claim | None = None
        self._guard: Ros2Guard | None = None
        self._unheard = False

    def open(self) -> None:
        """Wait for a first message of each topic.

        Raises:
            DeviceError: something is missing or wrong, or another agent drives the robot; one line says
                what and where.
        """
        self._take_odometry(time.monotonic() + PATIENCE)
        if self._claim is None:
            # Tried again as long as the robot is waited for: an agent that is dead may still be announced.
            self._claim = Claim(
                self._node.bus, CommandKeys(self._node.link), self._command, 0.0,
                f"another agent drives the robot by {self._command}; stop it, or give this robot another "
                f"namespace. One that hangs, or has lost the network, is gone after {LEASE:g} s",
            )  # fmt: skip
        end = time.monotonic() + PATIENCE
        self._check_images(end)
        if self._ranges and not self._rangers:
            self.geometry = self._with_rangers(end)
        self._guard = Ros2Guard(self._options.endpoint, self._stops())

    def close(self) -> None:
        """Stop the wheels, by the guard as well. The node stays: it connects again by itself.

        Without a guard nothing has been driven, and another agent may drive.
        """
        if self._guard is not None:
            self.publish(Command())
            self._guard.close()
            self._guard = None

    def nearest(self, speeds: Wheels) -> Wheels:
        """The speeds themselves: a Twist can say any."""
        return speeds

    def drive(self, speeds: Wheels) -> None:
        """Publish speeds."""
        assert self._guard is not None
        stops = self._stops()
        if stops != self._guard.stop:
            # There is a subscriber of another type.
            self._guard.close()
            self._guard = Ros2Guard(self._options.endpoint, stops)
        moving = any(speeds)
        self._guard.moving(moving)
        self.publish(Command((speeds.left + speeds.right) / 2, (speeds.right - speeds.left) / self._axle))
        unheard = not (self._twist.subscribers or self._stamped.subscribers)
        if moving and unheard and not self._unheard and self._node.connected():
            log.warning("no node subscribes to %s: the robot does not move", self._options.command)
            self._unheard = True
        self._unheard = self._unheard and unheard

    def publish(self, command: Command) -> None:
        """Publish a command in the type or types of its subscribers."""
        twist = making.twist(command)
        for publisher in self._publishers():
            if publisher is self._twist:
                publisher.publish(twist)
            else:
                head = making.header(self._clock.remote(now_ns()), BASE)
                publisher.publish(make(STAMPED_TYPE, header=head, twist=twist))

    def read(self) -> BaseReading:
        """The newest of each topic.

        Raises:
            DeviceError: there is no odometry any more, or it is wrong.
        """
        if self._odometry.silent:
            raise DeviceError(f"{self._odometry.name}: no odometry for {STALE:g} s")
        stamp_ns = self._take_odometry(0.0)
        kidnap, hazards = self._kidnap.newest(), self._hazards.newest()
        touches = () if hazards is None or self._hazards.silent else hazards.message.detections
        bumped = any(one.type in (BUMP, STALL) for one in touches)
        kidnapped = kidnap is not None and bool(kidnap.message.is_kidnapped)
        battery = self._battery.newest()
        charge = math.nan if battery is None else float(battery.message.percentage)
        return BaseReading(
            self._wheels.way, self._proximity(), bumped, charge if 0.0 <= charge <= 1.0 else None, kidnapped,
            stamp_ns,
        )  # fmt: skip

    def _take_odometry(self, end: float) -> int:
        """Add the newest odometry; returns its stamp."""
        received = self._odometry.first("odometry", end - time.monotonic())
        try:
            self._wheels.update(received.kind, received.message, received.stamp_ns)
        except DeviceError as error:
            raise DeviceError(f"{self._odometry.name}: {error}") from None
        return received.stamp_ns

    def _odometry_source(self, endpoint: Endpoint, token: str, alive: bool) -> None:
        """A publisher of the odometry comes or goes. Steps between poses of two are no motion."""
        if endpoint.kind != ODOMETRY_TYPE:
            return
        (self._sources.add if alive else self._sources.discard)(token)
        if alive and len(self._sources) > 1:
            log.warning(
                "%s has %d publishers, whose poses are mixed: let only one publish there, or give "
                "[robot.options] odometry another topic",
                self._odometry.name,
                len(self._sources),
            )

    def _command_source(self, endpoint: Endpoint, token: str, alive: bool) -> None:
        """Another publisher of commands comes or goes, which may be of use, as to drive by hand."""
        if alive and endpoint.kind in (TWIST_TYPE, STAMPED_TYPE) and f"/{NODE}/" not in token:
            log.warning(
                "%s has another publisher, which drives the robot, too: let it drive only while this agent "
                "does not", endpoint.topic,
            )  # fmt: skip

    def _check_images(self, end: float) -> None:
        """Find out what camera it is, and whether the images are its."""
        first = self.images.first("images", end - time.monotonic())
        try:
            height, width = grey_of(first.message).shape
        except DeviceError as error:
            raise DeviceError(f"{self.images.name}: {error}") from None
        source = "[robot.camera]"
        if self._info is not None:
            source = self._info.name
            self.camera = self._camera_by_info(self._info, str(first.message.header.frame_id), end)
        assert self.camera is not None
        if (width, height) != (self.camera.width, self.camera.height):
            raise DeviceError(
                f"{self.images.name}: images of {width}x{height} px, but {source} is for "
                f"{self.camera.width}x{self.camera.height} px; give [robot.camera], or another topic"
            )

    def _camera_by_info(self, info: NewestMessage, frame: str, end: float) -> CameraSettings:
        received = info.first("camera calibration ([robot.camera] can replace it)", end - time.monotonic())
        try:
            c, lens, distortion = camera_of(received.message, self._rectified)
        except DeviceError as error:
            raise DeviceError(f"{info.name}: {error}; calibrate it, or give [robot.camera]") from None
        height, forward, mount = self._options.height_m, self._options.forward_m, None
        if height is None:
            frame = str(received.message.header.frame_id) or frame
            mount = self._mounts.camera(frame, end - time.monotonic())
            if mount is None:
                raise DeviceError(
                    f"{self._mounts.name} does not tell where {frame or 'the camera'} is on the robot: "
                    "give [robot.options] height_m and forward_m"
                )
            height, forward = mount.up, mount.forward
        for line in doubts(received.message, mount, self._rectified):
            log.warning("%s: %s", info.name, line)
        try:
            return CameraSettings(
                c.width, c.height, c.fx, c.fy, c.cx, c.cy, height, forward, lens, distortion
            )
        except InvalidValue as error:
            raise DeviceError(f"{info.name}: {error}; calibrate it, or give [robot.camera]") from None

    def _with_rangers(self, end: float) -> Geometry:
        """The directions and reach of all sensors."""
        rangers = []
        for topic in self._ranges:
            received = topic.first("readings", end - time.monotonic())
            frame, known = str(received.message.header.frame_id), self._given.ranger_bearings_deg is not None
            mount = self._mounts.sensor(frame, 0.0 if known else end - time.monotonic())
            try:
                rangers.append(Ranger(received.kind, received.message, mount, self._radius))
            except DeviceError as error:
                raise DeviceError(f"{topic.name}: {error}") from None
        given = self._given.ranger_bearings_deg
        bearings = [math.degrees(b) for ranger in rangers for b in ranger.bearings]
        if not all(ranger.bearings for ranger in rangers) and given is None:
            raise DeviceError(
                f"{self._mounts.name} does not tell where the sensors look: "
                "give [robot.geometry] ranger_bearings_deg"
            )
        self._rangers = rangers
        return replace(
            KNOWN,
            ranger_bearings_deg=tuple(bearings if given is None else given),
            ranger_reach=min(ranger.reach for ranger in rangers),
        )

    def _proximity(self) -> NDArray[np.float64]:
        """(K,) m; empty if a sensor is silent."""
        reach = self._given.ranger_reach or self.geometry.ranger_reach or 0.0
        readings: list[NDArray[np.float64]] = []
        given = self._given.ranger_bearings_deg
        for topic, ranger in zip(self._ranges, self._rangers, strict=True):
            received = topic.newest()
            if received is None or topic.silent:
                return np.zeros(0)
            chosen = ranger.bearings
            if given is not None and received.kind == ros2_ranges.SCAN_TYPE:
                chosen = tuple(math.radians(b) for b in given)
            readings.append(ranger.distances(received.message, chosen))
        return np.minimum(np.concatenate(readings), reach) if readings else np.zeros(0)

    def _publishers(self) -> list[Publisher]:
        """Those of the types that are subscribed to, or were before all subscribers vanished.

        A key of the bridge does not tell the type: there, only one type may be published, and none before a
        subscriber is announced.
        """
        wanted = [one for one in (self._twist, self._stamped) if one.subscribers]
        if wanted:
            self._subscribed = wanted[:1] if self._options.bridge else wanted
        return self._subscribed

    def _stops(self) -> dict[str, bytes]:
        """What stops the wheels, on each key."""
        zero = making.twist(Command())
        # ros2_control takes a time of zero for the time of arrival.
        stamped = make(STAMPED_TYPE, header=making.header(0, BASE), twist=zero)
        return {
            key: encode(zero if publisher is self._twist else stamped)
            for publisher in self._publishers()
            for key in publisher.keys
        }


class Ros2(WheeledRobot):
    """ROS 2 robots (TurtleBot, Create 3, ROSbot) over rmw_zenoh or zenoh-bridge-ros2dds."""

    def __init__(self, settings: RobotSettings) -> None:
        """Join the ROS 2 graph in the options."""
        options = settings.options_as(Ros2Options)
        self._node = Ros2Node(options, NODE)
        try:
            self._ros = Ros2Base(self._node, options, settings)
            super().__init__(self._ros, settings, Ros2Camera(self._ros.images))
        except BaseException:
            self._node.close()
            raise

    def close(self) -> None:
        """Stop the wheels and leave the graph. May be called twice."""
        super().close()
        self._node.close()

    def _put_together(self) -> RobotDescription:
        return replace(self._settings, camera=self._ros.camera).describe(self._ros.geometry)
