"""A robot of ROS 2 topics, on the second implementation of the wire format."""

import math
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from tests import ros2_peer as peer
from tests.agent.drivers.contract import HEIGHT, WIDTH
from tests.agent.drivers.emulators import TwoWheels
from tests.ros2_peer import Publisher, RosPeer
from tests.waiting import free_port

PERIOD = 0.03
"""s between two messages of each topic."""
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""From x right, y down, z forward to x forward, y left, z up."""
KINDS = {
    "image": "sensor_msgs/msg/Image", "compressed": "sensor_msgs/msg/CompressedImage",
    "camera_info": "sensor_msgs/msg/CameraInfo", "odom": "nav_msgs/msg/Odometry",
    "joint_states": "sensor_msgs/msg/JointState", "wheel_ticks": "irobot_create_msgs/msg/WheelTicks",
    "scan": "sensor_msgs/msg/LaserScan", "range": "sensor_msgs/msg/Range",
    "ir_intensity": "irobot_create_msgs/msg/IrIntensityVector",
    "hazard_detection": "irobot_create_msgs/msg/HazardDetectionVector",
    "battery_state": "sensor_msgs/msg/BatteryState",
    "kidnap_status": "irobot_create_msgs/msg/KidnapStatus", "tf_static": "tf2_msgs/msg/TFMessage",
}  # fmt: skip
TOPICS = {
    "image": "/camera/image_raw", "compressed": "/camera/image_raw/compressed",
    "camera_info": "/camera/camera_info",
}  # fmt: skip


class Ros2Robot:
    """Publishes, and drives as commands say, for ever: while it is in reach it has no time-out of its own.

    Attributes:
        wheels: what drives.
        stalled: whether it neither publishes nor drives.
        walls: m, what each of the scanner's 90 rays measures.
        ranges: m, by the frame of each Range sensor.
        kidnapped: whether it is lifted.
        battery: its charge, as a share.
        hazards: types of what it notices.
        axle: m.
        clock_ns: how far its clock is ahead of this computer's.
        silent: names of topics without messages.
        camera: quaternion of its camera's frame, x ahead.
    """

    def __init__(
        self,
        stamped: bool = False,
        bridge: str | None = None,
        silent: Iterable[str] = (),
        lens: Mapping[str, Any] | None = None,
        pose: Sequence[float] = (0.0, 0.0, 0.0),
        encoding: str = "rgb8",
        camera: tuple[float, ...] = UPRIGHT,
    ) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.wheels, self.axle, self.stamped, self.bridge = TwoWheels(), 0.25, stamped, bridge
        self.stalled, self.kidnapped = False, False
        self.hazards: list[int] = []
        self.walls = [math.inf] * 90
        self.ranges = {"front": 1.0}
        self.infrared: list[tuple[str, int]] = []
        self.clock_ns, self.battery = 0, math.nan
        self.silent = set(silent)
        self.lens = {"width": WIDTH, "height": HEIGHT, "focal": 60.0, **(lens or {})}
        self.pose = list(pose)
        self.encoding, self.camera = encoding, camera
        self._before = (0.0, 0.0)
        self._noise = np.random.default_rng(0)
        self._router: ZenohBus | None = None
        self.plug_in()
        self.peer = RosPeer(self.endpoint, bridge=bridge)
        self._publishers: dict[str, Publisher] = {}
        kind = "geometry_msgs/msg/TwistStamped" if stamped else "geometry_msgs/msg/Twist"
        self._commands = self.peer.subscriber("/cmd_vel", kind)
        self._closing = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def plug_in(self) -> None:
        """The router comes up; sessions find it by themselves."""
        self._router = ZenohBus(BusSettings(mode="router", listen=(self.endpoint,)))

    def unplug(self) -> None:
        """The network is gone; the robot's own time-out stops its wheels."""
        self.wheels.set(0.0, 0.0)
        assert self._router is not None
        self._router.close()
        self._router = None

    def publisher(self, name: str) -> Publisher:
        if name not in self._publishers:
            topic, kind = TOPICS.get(name, f"/{name}"), KINDS[name]
            self._publishers[name] = self.peer.publisher(topic, kind, latched=name == "tf_static")
        return self._publishers[name]

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        self.peer.close()
        if self._router is not None:
            self.unplug()
        assert not self.peer.failures, self.peer.failures

    def _serve(self) -> None:
        self._publish("tf_static", peer.transforms(
            (0, "base_link", "camera_link", (0.07, 0.0, 0.2), self.camera),
            (0, "camera_link", "camera_optical_frame", (0.0, 0.0, 0.01), OPTICAL),
            (0, "base_link", "base_scan", (-0.03, 0.0, 0.15), (0.0, 0.0, 1.0, 0.0)),
            (0, "base_link", "front", (0.12, 0.0, 0.1), UPRIGHT),
            # As on the Create 3, the footprint hangs below the base.
            (0, "base_link", "base_footprint", (0.0, 0.0, -0.05), UPRIGHT),
        ))  # fmt: skip
        due = time.monotonic()
        while not self._closing:
            if self.stalled:
                self._commands.clear()
            else:
                self._drive()
                if time.monotonic() >= due:
                    due = time.monotonic() + PERIOD
                    self._tell()
            time.sleep(0.002)

    def _drive(self) -> None:
        while self._commands:
            forward, turn = peer.twist(self._commands.pop(0), self.stamped)
            self.wheels.set(forward - turn * self.axle / 2, forward + turn * self.axle / 2)

    def _tell(self) -> None:
        way = self.wheels.way()
        left, right = (b - a for a, b in zip(self._before, way, strict=True))
        self._before = way
        forward, turn = (left + right) / 2, (right - left) / self.axle
        x, y, heading = self.pose
        x += forward * math.cos(heading + turn / 2)
        y += forward * math.sin(heading + turn / 2)
        self.pose = [x, y, heading + turn]
        now = time.time_ns() + self.clock_ns
        pixels = self._noise.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        raw = peer.image(now, WIDTH, HEIGHT, self.encoding, 3 * WIDTH, pixels.tobytes())
        self._publish("image", raw)
        jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
        self._publish("compressed", peer.compressed(now, "rgb8; jpeg compressed bgr8", jpeg))
        self._publish("camera_info", peer.camera_info(now, **self.lens))
        self._publish("odom", peer.odometry(now, *self.pose))
        names = ["wheel_left_joint", "wheel_right_joint"]
        self._publish("joint_states", peer.joint_states(now, names, [one / 0.033 for one in way]))
        ticks = [round(508.8 * one / (2 * math.pi * 0.03575)) for one in way]
        # Counters that wrap around soon.
        ticks = [(tick + 2**31 - 50 + 2**31) % 2**32 - 2**31 for tick in ticks]
        self._publish("wheel_ticks", peer.wheel_ticks(now, *ticks))
        self._publish("scan", peer.scan(now, "base_scan", 0.0, math.tau / 90, 0.1, 3.5, self.walls))
        for frame, distance in self.ranges.items():
            self._publish("range", peer.range_reading(now, frame, 0.02, 2.0, distance))
        self._publish("ir_intensity", peer.ir_intensity(now, self.infrared))
        self._publish("hazard_detection", peer.hazards(now, self.hazards))
        self._publish("battery_state", peer.battery_state(now, self.battery))
        self._publish("kidnap_status", peer.kidnap_status(now, self.kidnapped))

    def _publish(self, name: str, message: peer.Cdr) -> None:
        if name not in self.silent:
            self.publisher(name).publish(message)
